"""``coloc reproduce stdcl``: what is missing is flown, then the report is written."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from coloc_env.options import require_known
from coloc_env.staging import staged_folder
from training.evaluation.evaluate import Progress
from training.reproduce.cost import Cost, measured
from training.reproduce.pool import Note, obtain
from training.reproduce.reporting import Text, write_report
from training.reproduce.stdcl import links, plan, report
from training.reproduce.stdcl.flown import Flown
from training.reproduce.stdcl.plan import METHODS, OPTIMIZER, REFERENCES, WHOLE, Plan
from training.reproduce.store import Store
from training.reproduce.study import Study, Variant

NAMES = (*report.FILES, "report.md")
_STORE = "store"
_WATCHED = (WHOLE, OPTIMIZER, f"{OPTIMIZER}:confidence=none")


def reproduce(
    out: Path,
    part: str,
    runs: int,
    seed: int,
    where: Sequence[str] | None,
    steps: int | None,
    jobs: int,
    missing: bool,
    tell: Progress,
    note: Note,
    n_uavs: int = 200,
) -> None:
    """Fly what the store in ``out`` lacks, then write the report of ``part`` (one of ``PARTS``, or
    ``all``) there.

    ``where``: these variants only; None: all. ``steps``: at most so many of each run.
    ``missing=False`` flies nothing. ``n_uavs``: of ``swarm-v0``, where it is not what is varied.
    """
    parts = plan.PARTS if part == "all" else (part,)
    the, study = Plan(runs, steps, n_uavs), Study(Store(out / _STORE), seed)
    scenes = plan.merged(scene for each in parts for scene in the.scenes(each))
    timed = _timed(the, parts)
    require_known("variant", where, dict.fromkeys((*scenes, *(v.key for v, _ in timed))))
    wanted = {key: s for key, s in scenes.items() if where is None or key in where}
    pieces = [piece for scene in wanted.values() for piece in scene.pieces(study)]
    obtain(study, pieces, jobs, tell, note, missing)
    cost: dict[str, dict[str, Cost]] = {}
    for variant, agents in timed:
        if where is None or variant.key in where:
            able = _able(study, variant, agents)
            cost[variant.key] = measured(study.store, variant, seed, able, tell, missing)
    flown = _watched(Flown(study, wanted, cost, {}, None, None), the, tell, missing)
    text: Text = []
    with staged_folder(out, NAMES) as folder:
        text += report.claims_part(flown, the, parts, folder)
        if "paper" in parts:
            text += report.paper_part(flown, the, folder)
        if "stress" in parts:
            text += report.stress_part(flown, the, folder)
        if "learned" in parts:
            text += report.learned_part(flown, the, folder)
        if "campus" in parts:
            text += report.campus_part(flown, the, folder)
        if "real" in parts:
            text += report.real_part(flown, the)
        write_report(folder, "ST-DCL", plan.TITLE, text, study)


def _timed(the: Plan, parts: Sequence[str]) -> list[tuple[Variant, tuple[str, ...]]]:
    """Where steps are timed, and whose."""
    found: list[tuple[Variant, tuple[str, ...]]] = []
    if "paper" in parts:
        for n in plan.GROWTH:
            dear = REFERENCES if n <= plan.JOINT_UP_TO else ()
            found.append((the.timed(n), (*METHODS, *dear)))
    if "campus" in parts:
        found.append((the.timed_flight(), (*METHODS, *REFERENCES)))
    return found


def _able(study: Study, variant: Variant, agents: Sequence[str]) -> list[str]:
    """Those that can be built; why the others cannot is noted."""
    study.missing([piece for agent in agents for piece in study.pieces(variant, agent, 1)])
    return [agent for agent in agents if (variant.key, agent) not in study.failed]


def _watched(flown: Flown, the: Plan, tell: Progress, missing: bool) -> Flown:
    """With the runs in which links are looked at, where their variants are wanted."""
    study, found = flown.study, flown
    split, light, long = the.flight("s2"), the.lighter(), the.long()

    def look(variant: Variant, agent: str) -> dict[str, links.Watched]:
        one = links.watched(study.store, variant, agent, study.seed, tell, missing)
        return {} if one is None else {agent: one}

    if split.key in flown.scenes and study.can(split):
        there: dict[str, links.Watched] = {}
        for agent in _able(study, light, _WATCHED):
            there |= look(light, agent)
        parted = look(split, OPTIMIZER).get(OPTIMIZER)
        found = replace(found, watched=there, parted=parted)
    if long.key in flown.scenes and _able(study, long, [WHOLE]):
        loop = links.loop(study.store, long, WHOLE, study.seed, tell, missing)
        found = replace(found, loop=loop)
    return found
