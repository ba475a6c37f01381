"""``coloc tasks`` and ``coloc score``."""

from pathlib import Path
from typing import Annotated, Any

import typer

from training.cli.options import Threads
from training.cli.terminal import explain, progress, show


def tasks(
    name: Annotated[
        str | None,
        typer.Argument(metavar="[TASK]", help="Show this task's options; none: list all."),
    ] = None,
) -> None:
    """List the tasks in which decisions matter, with stored scores, or one task's options and
    heuristics.

    **Examples**

    coloc tasks

    coloc tasks survey-v0
    """
    from agents.tasks import TASKS
    from agents.tasks.leaderboard import scores
    from coloc_env.options import paragraphs

    if name is None:
        found = scores()
        lines = [[key, _best(found.get(key, [])), TASKS.summary(key)] for key in TASKS]
        show(["task", "returns: random, best known", ""], lines)
        typer.echo("coloc tasks TASK lists its options and its heuristics.")
        return
    explain(name, TASKS, "option")
    for what in ("policies", "planners"):
        found = getattr(TASKS[name], what, {})
        rows = [[key, paragraphs(rule.__doc__ or "")[0]] for key, rule in found.items()]
        if rows:
            typer.echo("")
            show([{"policies": "heuristic", "planners": "planner"}[what], ""], rows)


def _best(stored: list[dict[str, Any]]) -> str:
    """Returns of random actions and of the best of some stored scores, the best first."""
    if not stored:
        return ""
    return f"{stored[0]['random']:.1f}, {stored[0]['return']:.1f} ({stored[0]['label']})"


def score(
    task: Annotated[str, typer.Argument(metavar="TASK", help="See **coloc tasks**.")],
    policy: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="A heuristic of the task, weights (**….safetensors**; several seeds': separated "
            "by commas), or **module:function** of your own.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the figures here, as JSON.")
    ] = None,
    worlds: Annotated[int, typer.Option(help="Worlds; fewer are no score to report.")] = 256,
    label: Annotated[
        str | None, typer.Option(help="What the leaderboard is to call the policy.")
    ] = None,
    link: Annotated[str | None, typer.Option(help="Where its code or paper is.")] = None,
    threads: Threads = 1,
) -> None:
    """Score a policy on a task's fixed worlds, which no training uses.

    **Examples**

    coloc score survey-v0 --policy frontier

    coloc score schedule-v0 --policy my_module:my_policy --out score.json

    coloc score survey-v0 --policy runs/1/policy.safetensors,runs/2/policy.safetensors
    """
    from training.threads import use_threads

    use_threads(threads)
    if worlds < 4:
        raise ValueError(f"--worlds {worlds} is not allowed: at least 4")
    import json

    from coloc_env.staging import require_writable, staged_file
    from training.evaluation.score import score as measure

    require_writable(out)
    with progress() as advance:
        found = measure(task, policy, worlds, advance)
    found |= {"label": label or policy, "link": link}
    if out is not None:
        with staged_file(out) as file:
            file.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    low, high = found["interval_95"]
    lines = [
        ["return", f"{found['return']:.2f} ± {found['standard_error']:.2f}"],
        ["interquartile mean", f"{found['interquartile_mean']:.2f} [{low:.2f}, {high:.2f}]"],
        ["share of random … best known", f"{found['share_of_span']:.2f}"],
        ["error, m", f"{found['error']:.2f}"],
        ["bytes", f"{found['bytes']:.0f}"],
        ["distance, m", f"{found['distance']:.0f}"],
        ["energy, kJ", f"{found['energy'] / 1000:.0f}"],
        ["others at random cost uav_0", f"{found['interaction']['cost']:.2f}"],
        ["ranges between UAVs are worth", f"{found['cooperation']['worth']:.2f}"],
    ]
    if "seeds" in found:
        low, high = found["seeds"]["interval_95"]
        iqm = found["seeds"]["interquartile_mean"]
        lines.append(["interquartile mean of seeds", f"{iqm:.2f} [{low:.2f}, {high:.2f}]"])
    show([f"{task}, {found['label']}", ""], lines)
