"""Figures of `coloc evaluate` for every agent in every scenario, on few steps: a fingerprint of
what the product computes, taken before and after a change that must not move a number.

    python .ci/figures.py take before.json          # in the checkout before (about ten minutes)
    python .ci/figures.py take after.json           # in the checkout after
    python .ci/figures.py compare before.json after.json

Only the command is used, so that checkouts of any layout can be compared. Figures of time are left
out. ``RENAMED`` and ``MEANT`` say which differences are meant.
"""

import json
import sys
import tempfile
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

SHORT = {  # scenario: overrides that make it short
    "campus-v0": ["horizon=12"],
    "indoor-v0": ["horizon=25"],
    "replay-euroc-v0": ["span=0:2"],
    "replay-hanyang-v0": ["span=0:3"],
    "replay-miluv-v0": ["span=0:2"],
    "replay-mrclam-v0": ["span=0:4"],
    "replay-murp-v0": ["span=0:12"],
    "replay-stein-euroc-team-v0": ["span=0:2"],
    "replay-stein-euroc-v0": ["span=0:3"],
    "replay-tiers-v0": ["span=0:4"],
    "replay-tuc-v0": ["span=0:4"],
    "stein2d-v0": ["horizon=12"],
    "stein3d-v0": ["horizon=8"],
    "swarm-v0": ["horizon=8", "n_uavs=60"],
    "wsn-v0": ["horizon=25"],
}
HARD = [
    "horizon=25",
    "landmarks=5",
    "nlos=0.3",
    "anchors=4",
    "false_matches=0.1",
    "message_loss=0.2",
]
OPTIONS = [  # of agents, in the hard world indoors
    "ekf:robust=huber+gate+ransac+temporal+cross",
    "ekf:fusion=ci",
    "ekf:cooperate=false",
    "ekf:iterations=3",
    "ekf_joint:robust=huber",
    "pf800:robust=huber",
    "pf500:tempering=false:proposal=ekf",
    "apf:bounds=100,400",
    "nnhpff:main=ekf@robust=huber",
    "hpff:main=apf:auxiliary=emvf@memory=5",
    "emvf:memory=5",
]
SWARM_OPTIONS = [
    "dwmds_st:confidence=paper",
    "dwmds_st:confidence=huber",
    "dwmds_st:bias=false",
    "map:delays=false",
    "map:confidence=none",
    "stdcl:bank=true",
    "stdcl:variant=calibrated",
    "stdcl:variant=calibrated:feedback=none",
    "stdcl:variant=calibrated:feedback=paper",
    "stdcl:variant=paper",
]
RENAMED: dict[str, str] = {"pfnn_trust": "pf_trust"}  # agents, before → after
MEANT = "would be ignored"  # refused now: a localizer no longer ignores what a team measures
UNTOUCHED = ("ms_per_step",)


def cases(agents: list[str]) -> list[tuple[str, list[str], str]]:
    """(scenario, overrides, agent) of everything that is compared."""
    found = [
        (scenario, settings, agent) for scenario, settings in SHORT.items() for agent in agents
    ]
    found += [("indoor-v0", HARD, agent) for agent in [*agents, *OPTIONS]]
    found += [("swarm-v0", SHORT["swarm-v0"], agent) for agent in SWARM_OPTIONS]
    return found + [
        ("indoor-v0", [*SHORT["indoor-v0"], "motion=random", "imu_bias=true"], agent)
        for agent in ("ekf", "pf800", "mappo", "ippo", "sb3-ppo")
    ]


def agents() -> list[str]:
    """Names of all agents."""
    from agents import LOCALIZERS

    return sorted(LOCALIZERS)


def one(case: tuple[str, list[str], str]) -> tuple[str, Any]:
    """What ``coloc evaluate`` writes of one agent, or the error's words."""
    warnings.simplefilter("ignore")
    from typer.testing import CliRunner

    try:
        from training.cli.command import app
    except ModuleNotFoundError:  # before the house was redrawn
        from training.cli import app

    scenario, settings, agent = case
    key = " ".join((scenario, *settings, agent))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        words = [
            "evaluate",
            scenario,
            "--agents",
            agent,
            "--runs",
            "2",
            "--seed",
            "5",
            "--no-figures",
        ]
        words += [] if agent == "dead_reckoning" else ["--no-bound"]
        words += [x for setting in settings for x in ("--set", setting)]
        result = CliRunner().invoke(app, [*words, "--out", str(out)])
        if not (out / "results.json").exists():
            return key, result.output.strip()[-300:] + (
                repr(result.exception) if result.exception else ""
            )
        found = json.loads((out / "results.json").read_text())
    figures = found["agents"][agent]
    for name in UNTOUCHED:
        figures.pop(name)
    return key, {"bound": found["bound"], "steps": found["steps"], **figures}


def take(file: Path) -> None:
    """Write the fingerprint of this checkout."""
    with ProcessPoolExecutor(2) as pool:
        found = dict(pool.map(one, cases(agents())))
    file.write_text(json.dumps(found, indent=1, sort_keys=True))
    print(f"{len(found)} cases, {sum(isinstance(x, str) for x in found.values())} refused")


def compare(before: Path, after: Path) -> int:
    """Print every difference that is not meant; the number of them."""
    old = json.loads(before.read_text())
    new = json.loads(after.read_text())
    wrong = meant = 0
    for key, figures in old.items():
        *where, agent = key.split(" ")
        renamed = " ".join((*where, RENAMED.get(agent, agent)))
        other = new.get(renamed)
        if figures == other or (isinstance(figures, str) and isinstance(other, str)):
            continue
        if isinstance(other, str) and MEANT in other:
            meant += 1
            continue
        wrong += 1
        print(f"DIFFERS: {renamed}")
        if isinstance(figures, dict) and isinstance(other, dict):
            for name in figures:
                if figures[name] != other.get(name):
                    print(f"    {name}: {figures[name]} -> {other.get(name)}")
        else:
            print(
                f"    {figures if isinstance(figures, str) else 'figures'} -> "
                f"{other if isinstance(other, (str, type(None))) else 'figures'}"
            )
    print(f"{len(old)} cases compared: {meant} refused now on purpose, {wrong} differ")
    return wrong


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["take", file]:
            take(Path(file))
        case ["compare", before, after]:
            sys.exit(bool(compare(Path(before), Path(after))))
        case _:
            sys.exit(__doc__)
