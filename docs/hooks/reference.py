"""Reference pages, written from what is registered: scenarios, agents, trainings, the command."""

import inspect
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parents[2]))  # the pages are about this checkout

from agents import LOCALIZERS
from coloc_env import SCENARIOS, make_scenario
from coloc_env.observation import action_width, message_leaves, sensed_leaves, static_leaves
from coloc_env.options import Option, typed
from coloc_env.registry import Registry
from coloc_env.scenario import Scenario
from coloc_env.sensors import Leaf
from training.learning.registry import TRAININGS

_OWN = {"override": "General", "option": ""}  # titles of options that belong to no group


def on_files(files: Files, config: Any, **_: Any) -> Files:
    pages = {
        "reference/scenarios/index.md": scenarios(),
        "reference/observations.md": observations(),
        "reference/agents.md": agents(),
        "reference/trainings.md": trainings(),
        "reference/command.md": command(),
    }
    for name in SCENARIOS:
        pages[f"reference/scenarios/{name}.md"] = scenario(name)
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


# ------------------------------------------------------------------ parts


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in cells) + "\n"


def described(thing: Any) -> str:
    """A docstring as Markdown."""
    return (inspect.getdoc(thing) or "").replace("``", "`") + "\n"


def value(thing: Any) -> str:
    """A setting as it is typed on a command line, as code."""
    if thing is inspect.Parameter.empty:
        return "must be given"
    return f"`{typed(thing)}`"


def options(known: Mapping[str, Option], kind: str, level: int) -> str:
    """Tables of options, a group each; those of the function itself first."""
    if not known:
        return f"No {kind}s.\n"
    groups = {option.group: option.about for option in known.values()}
    text = []
    for group in sorted(groups, key=bool):
        rows = [
            [f"`{one.name}`", one.words.replace("one of ", ""), one.unit, value(one.default)]
            for one in known.values()
            if one.group == group
        ]
        title = group[:1].upper() + group[1:] if group else _OWN[kind]
        text += [f"{'#' * level} {title}\n"] if title else []
        text += [groups[group].replace("``", "`") + "\n"] if groups[group] else []
        text += [table([kind, "allowed", "unit", "default"], rows)]
    return "\n".join(text)


def built(name: str) -> Scenario | None:
    """The scenario with its defaults; None for a recording that is not on this machine."""
    try:
        return make_scenario(name)
    except (ValueError, OSError):
        if name.startswith("replay-"):
            return None
        raise


def mask(name: str, leaves: Mapping[str, Leaf]) -> str:
    """The leaf that says which of another's entries are there; empty if all always are."""
    for stem in (name.removesuffix("s"), name, name.removesuffix("s").removesuffix("e")):
        if f"{stem}_mask" in leaves and name != f"{stem}_mask":
            return f"`{stem}_mask`"
    return ""


def unit(leaf: Leaf) -> str:
    return leaf.unit or ("0 or 1" if (leaf.low, leaf.high) == (0, 1) else "index")


def owners(built: Scenario) -> dict[str, tuple[Leaf, str]]:
    """Every leaf of an observation, and what it comes from."""
    found: dict[str, tuple[Leaf, str]] = {}
    for sensor in built.sensors:
        kind = type(getattr(sensor, "sensor", sensor)).__name__
        for name, leaf in (sensor.leaves(built.layout) | sensor.map_leaves(built.layout)).items():
            found[name] = (leaf, f"[`{kind}`](SENSORS)")
    for name, leaf in sensed_leaves(built).items():
        found.setdefault(name, (leaf, "who is in radio reach, by slot"))
    for name, leaf in message_leaves(built).items():
        found[name] = (leaf, "others' last actions, by slot")
    for name, leaf in static_leaves(built).items():
        found.setdefault(name, (leaf, "what the UAV knows of its start"))
    return found


# ------------------------------------------------------------------ scenarios


def scenarios() -> str:
    rows = [[f"[`{name}`]({name}.md)", SCENARIOS.summary(name)] for name in SCENARIOS]
    return "\n".join(
        [
            "# Scenarios\n",
            "A scenario is a world, and what its team believes of it. Every override of the pages "
            "below is a keyword of `parallel_env`, `CoLocEnv` and `CoLocVecEnv`, and a `--set` of "
            "the command. Those called `replay-…` replay a recording: "
            "[where they come from](../../how-to/recordings.md).\n",
            table(["scenario", "what it is"], rows),
        ]
    )


def scenario(name: str) -> str:
    known, made = SCENARIOS.options_of(name), built(name)
    text = [f"# {name}\n", described(SCENARIOS[name])]
    if made is None:
        text += [
            '!!! note "Built without this recording"\n\n    Its observation table needs the data: '
            "[where they come from](../../how-to/recordings.md).\n"
        ]
    else:
        text += ["## At a glance\n", glance(made), "## Observation\n", leaves(made)]
    return "\n".join([*text, "## Overrides\n", options(known, "override", 3)])


def glance(made: Scenario) -> str:
    arena = made.arena
    sides = " × ".join(f"{b - a:g}" for a, b in zip(arena.low, arena.high, strict=True))
    real = {type(getattr(sensor, "sensor", sensor)).__name__ for sensor in made.sensors}
    rows = [
        ["UAVs", str(arena.n_uavs)],
        ["space", f"{arena.dim}-D, {sides} m"],
        ["time", f"{made.horizon} steps of {arena.dt:g} s"],
        ["sensors", ", ".join(f"`{kind}`" for kind in sorted(real))],
        ["believed motion", f"`{type(made.process).__name__}`"],
        ["action", f"{action_width(made)} numbers: [what they mean](../actions.md)"],
        ["reward", f"`{made.reward}`"],
    ]
    return table(["", ""], rows)


def leaves(made: Scenario) -> str:
    """The table of a scenario's observation."""
    found = owners(made)
    names = {name: leaf for name, (leaf, _) in found.items()}
    rows = [
        [
            f"`{name}`",
            str(leaf.width),
            unit(leaf),
            leaf.frame,
            mask(name, names),
            source.replace("SENSORS", "../api/coloc_env.md#sensors"),
        ]
        for name, (leaf, source) in found.items()
    ]
    header = ["leaf", "numbers", "unit", "frame", "mask", "from"]
    return "Float32 Boxes of each UAV; masked entries are 0.\n\n" + table(header, rows)


def observations() -> str:
    """Every leaf of every scenario."""
    entries: dict[str, tuple[dict[str, None], Leaf, str, str, list[str]]] = {}
    for name in SCENARIOS:
        made = built(name)
        if made is None:
            continue
        found = owners(made)
        known = {key: leaf for key, (leaf, _) in found.items()}
        for key, (leaf, source) in found.items():
            entry = entries.setdefault(key, ({}, leaf, source, mask(key, known), []))
            entry[0][unit(leaf)] = None
            entry[4].append(f"{name} ({leaf.width})")
    rows = [
        [
            f"`{key}`",
            " or ".join(units),
            leaf.frame,
            covered,
            source.replace("SENSORS", "api/coloc_env.md#sensors"),
            ", ".join(where),
        ]
        for key, (units, leaf, source, covered, where) in sorted(entries.items())
    ]
    header = ["leaf", "unit", "frame", "mask", "from", "in (numbers a UAV)"]
    return "\n".join(
        [
            "# Observations\n",
            "What a UAV observes is a Dict of flat float32 Boxes, the *leaves* below: the same "
            "names and widths on every interface. A mask is 1 where an entry was measured and 0 "
            "where not; masked entries are 0. Maps and the prior stay the same over an episode. "
            "The frame of quaternions is body to world, wxyz; a body looks forward, left and "
            "up.\n",
            table(header, rows),
            "[Action modes](actions.md) for learners add leaves of their own. The page of a "
            "sensor class says how its numbers are laid out.\n",
        ]
    )


# ------------------------------------------------------------------ agents and trainings


def registered(registry: Registry, kind: str, served: bool = False) -> str:
    text = []
    for name in registry:
        made = registry[name]
        text += [f"## {name}\n", described(made)]
        serves = getattr(made, "serves", None) if served else None
        if serves is not None:
            sensors = ", ".join(f"`{sensor.__name__}`" for sensor in serves)
            text += [f"Uses {sensors}, and refuses what it would ignore.\n"]
        text += [options(registry.options_of(name), kind, 3)]
    return "\n".join(text)


def agents() -> str:
    return (
        "# Agents\n\nEstimators and policies by name. Options follow the name after colons: "
        "`ekf:robust=huber:fusion=ci`, on the command line and in `agents.make`.\n\n"
        + registered(LOCALIZERS, "option", served=True)
    )


def trainings() -> str:
    return (
        "# Trainings\n\nWhat `coloc train NAME` can learn, and the options that `--set` takes.\n\n"
        + registered(TRAININGS, "option")
    )


# ------------------------------------------------------------------ the command


def command() -> str:
    """Help of every subcommand, as a page."""
    import typer.main

    from training.cli.command import app

    group: Any = typer.main.get_command(app)
    text = ["# The command\n", "`coloc COMMAND --help` says the same.\n"]
    for name, one in group.commands.items():
        text += _subcommand(f"coloc {name}", one)
    return "\n".join(text)


def _subcommand(name: str, one: Any) -> list[str]:
    nested = getattr(one, "commands", {})
    text = [f"## {name}\n", examples(one.help or "") + "\n"]
    rows = [
        [
            ", ".join(f"`{word}`" for word in each.opts + each.secondary_opts)
            if each.param_type_name == "option"
            else f"`{each.metavar or each.name.upper()}`",
            getattr(each, "help", None) or "",
            "" if each.default is None or callable(each.default) else value(each.default),
        ]
        for each in one.params
        if each.name != "help"
    ]
    text += [table(["argument", "", "default"], rows)] if rows else []
    for inner, each in nested.items():
        text += _subcommand(f"{name} {inner}", each)
    return text


def examples(text: str) -> str:
    """Help as Markdown: paragraphs that are a command line become code."""
    paragraphs = [" ".join(one.split()) for one in text.replace("``", "`").split("\n\n")]
    return "\n\n".join(
        f"```bash\n{one}\n```" if one.startswith("coloc ") else one for one in paragraphs
    )
