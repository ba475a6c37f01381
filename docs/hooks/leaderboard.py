"""The leaderboard: a table a task, made from the stored results of ``coloc score``."""

from typing import Any

from mkdocs.structure.files import File, Files

from agents.tasks.leaderboard import scores

_HEAD = """# Leaderboard

How well policies do in the [tasks](tasks.md), on the 256 worlds of the protocol, which no training
uses. Every row is a file of `agents/tasks/scores/`, as `coloc score` wrote it; `coloc tasks` shows
the best.

## How to submit

1. Score your policy: a function, or weights of each of your training seeds.

    ```bash
    coloc score survey-v0 --policy my_module:my_policy --label "My method" --out my_method.json
    ```

2. Put the file into `agents/tasks/scores/survey-v0/` and open a pull request that links code with
   which we can run the same command (`--link`). What cannot be run again is not listed.

Policies that take `Seen.memory` read the estimator's joint belief, and so are central; those that
take `Seen.observation` alone are decentralized where the task's `telemetry` is `messages`.

Returns are means over the worlds; IQM is the interquartile mean with its 95 % bootstrap interval
over worlds; span is the share of the way from random actions to the best heuristic. Interaction is
what `uav_0` loses when the others act at random; cooperation is what ranges between UAVs are worth.
"""


def page() -> str:
    names = ("policy", "return", "IQM", "error, m", "span", "interaction", "cooperation", "bytes")
    header = "| " + " | ".join((*names, "distance, m", "worlds")) + " |"
    text = [_HEAD]
    for task, rows in sorted(scores().items()):
        text += [f"## {task}\n", header, "|---|" + 9 * "---:|"]
        text += ["| " + " | ".join(_row(one)) + " |" for one in rows]
        text += [""]
    return "\n".join(text)


def _row(one: dict[str, Any]) -> list[str]:
    low, high = one["interval_95"]
    name = f"[{one['label']}]({one['link']})" if one.get("link") else f"`{one['label']}`"
    share = one["share_of_span"]
    return [
        name,
        f"{one['return']:.2f} ± {one['standard_error']:.2f}",
        f"{one['interquartile_mean']:.2f} [{low:.2f}, {high:.2f}]",
        f"{one['error']:.2f}",
        "" if share is None else f"{share:.2f}",
        f"{one['interaction']['cost']:.1f}",
        f"{one['cooperation']['worth']:.1f}",
        f"{one['bytes']:.0f}",
        f"{one['distance']:.0f}",
        str(one["worlds"]),
    ]


def on_files(files: Files, config: Any, **_: Any) -> Files:
    files.append(File.generated(config, "results/leaderboard.md", content=page()))
    return files
