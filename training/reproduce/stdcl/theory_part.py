"""The part of the study on theory: what its errors do in time and in space, what the paper's own
settings of the optimizer and of the loop are worth."""

from collections.abc import Callable, Iterator
from importlib.util import find_spec

import numpy as np
from matplotlib.figure import Figure

from training.evaluation.metrics import Difference, Floats
from training.reproduce.drawing import legend, panels
from training.reproduce.measures import rmse
from training.reproduce.results import Results, Runs
from training.reproduce.settings import Settings
from training.reproduce.stdcl import plan, theory
from training.reproduce.stdcl.claims import of
from training.reproduce.stdcl.plan import HUBER, OPTIMIZER, PAPERS_OPTIMIZER, W
from training.reproduce.stdcl.sdp import SDP, Relaxation
from training.reproduce.stdcl.style import log, style_of
from training.reproduce.stdcl.theory import DIFFUSION, Diffusion
from training.reproduce.tables import Table, number, signed, with_ends
from training.reproduce.verdicts import Claim, exactly, gain_in, interval, mean_of
from training.reproduce.work import WORLD, Cell

FEW, MANY = 0.1, 0.4  # NLOS shares by which the power is taken
WATCHED = (HUBER, OPTIMIZER)
SNAPSHOTS = "gn:confidence=none"
KAPPAS = (0.005, 0.02, 0.05, 0.2)
ALONE = "stdcl:variant=paper:weights=none"  # equation 36 on the optimizer, no network
SETTINGS = {
    PAPERS_OPTIMIZER: "the paper's weights; the prior of its covariance",
    f"{PAPERS_OPTIMIZER}:window=10": "+ window of T = 10 steps, λ fixed",
    f"{PAPERS_OPTIMIZER}:adaptive=true": "λ_s above the spectral radius",
    f"{PAPERS_OPTIMIZER}:adaptive=true:window=10": "+ window of T = 10 steps, λ adaptive",
} | {f"{ALONE}:kappa={k:g}": f"feedback of eq. 36, κ = {k:g}" for k in KAPPAS}


def cells(n_uavs: int, settings: Settings) -> Iterator[Cell]:
    """Errors over time by speed and by NLOS share, wrong fixes, and settings."""
    worlds, some = plan.Worlds(n_uavs, settings.steps), settings.fraction(10)
    for v_max in (plan.FAST, plan.MODERATE, plan.SLOW):
        yield Cell(worlds.speed(v_max), WATCHED, some)
    for nlos in (0.0, FEW, MANY):
        yield Cell(worlds.share(nlos), WATCHED, some)
    for variant in (worlds.sparse(2000.0), worlds.speed(plan.MODERATE)):
        yield Cell(variant, (HUBER,), 1, DIFFUSION)
    for variant in _set_in(worlds):
        yield Cell(variant, tuple(SETTINGS), some)
    if find_spec("cvxpy") is not None:
        for variant in _few(settings.steps):
            yield Cell(variant, (SNAPSHOTS,), 1, SDP)


def _few(steps: int | None = None) -> tuple[plan.Variant, ...]:
    """Thirty UAVs for ten steps, everybody in reach or few: what a general solver copes with."""
    worlds = plan.Worlds(30, min(10, steps or 10))
    return tuple(
        worlds.swarm(f"sdp-{reach:g}", f"30 UAVs, R = {reach:g} m", comm_radius=reach, nlos=0.0)
        for reach in (15000.0, 5000.0)
    )


def _set_in(worlds: plan.Worlds) -> tuple[plan.Variant, ...]:
    return worlds.speed(plan.MODERATE), worlds.lasting(0.15)


def text(settings: Settings) -> list[str]:
    """What is to be known of it."""
    return [
        "Equations 7 to 10, 15 and 16 are lost in our text and restored from the paper's words.",
        "`adaptive=true` has λ and λ_s as printed. T = min(T_max, ⌈√(2R/a_max)/Δt⌉) does not change"
        " in time; with T_max = 10 it is less only for a reach below 50 s² · a_max.",
    ]


def claims(settings: Settings) -> Iterator[Claim]:
    """Section 3.2."""
    fast = W.speed(plan.FAST).key
    for agent, name in ((WORLD, "dead reckoning"), (HUBER, "DW-MDS")):
        claim = Claim(
            f"v_max 100, {name}: the coupling α of equation 7 exceeds 1 in manoeuvres",
            "> 1",
            "",
            "above",
            1.0,
        )
        yield of(claim, ((fast, agent),), lambda one: interval(theory.couplings_by_turns(one)[0]))
        claim = Claim(
            f"v_max 100, {name}: α is larger in the sharpest tenth of turns than in the mildest",
            "amplified",
            "",
            "above",
        )
        yield of(claim, ((fast, agent),), _by_turns)
        claim = Claim(
            f"v_max 100, {name}: theorem 1 bounds the error of the last step (multiple of it)",
            "upper bound",
            "",
            "above",
            1.0,
        )
        yield of(claim, ((fast, agent),), mean_of(theory.looseness))
    for agent, name in ((HUBER, "Huber"), (OPTIMIZER, "calibrated")):
        claim = Claim(
            f"{name}: errors rise with the square of the NLOS share", "squared", "", None, 2.0
        )
        needs = tuple((W.share(x).key, agent) for x in (MANY, FEW, 0.0))
        yield of(claim, needs, _power)
    for variant in (W.sparse(2000.0), W.speed(plan.MODERATE)):
        claim = Claim(
            f"{variant.title}: no UAV moves further than the wrong fix (equation 10's bound, its"
            " weights normalized)",
            "upper bound",
            "",
            "below",
            1.0,
        )
        yield of(claim, ((variant.key, HUBER, DIFFUSION),), _furthest)


def _by_turns(one: Runs) -> Difference:
    most, least = theory.couplings_by_turns(one)
    return interval(most - least)


def _power(more: Runs, less: Runs, none: Runs) -> Difference:
    return interval(theory.power(rmse(more), rmse(less), rmse(none), MANY / FEW))


def _furthest(found: Diffusion) -> Difference:
    return exactly(float(found.moved.max()))


def tables(results: Results) -> Iterator[Table]:
    """Recursion, diffusion, settings."""
    rows = []
    for v_max in (plan.FAST, plan.MODERATE, plan.SLOW):
        there = results.runs(W.speed(v_max).key, [WORLD, *WATCHED])
        for agent, one in there.items():
            measures: tuple[Callable[[Runs], Floats], ...] = (
                theory.couplings,
                lambda x: theory.couplings_by_turns(x)[0],
                lambda x: theory.couplings_by_turns(x)[1],
                theory.looseness,
            )
            cells = [with_ends(measure)(one) for measure in measures]
            rows.append([f"{v_max:g}", f"`{agent}`", *cells])
    header = ["v_max (m/s)", "agent", "α", "α, sharpest turns", "α, mildest", "bound ÷ error"]
    yield Table("Equation 7 and theorem 1", header, rows, 2)
    yield _diffusion(results)
    yield _settings(results)
    rows = []
    for variant in _few():
        found: Relaxation | None = results.get(variant.key, SNAPSHOTS, SDP)
        for method, error in ({} if found is None else found.rmse).items():
            assert found is not None
            rows.append([variant.title, method, number(error), number(found.gap.mean(), "{:.4f}")])
    header = ["worlds", "from one step's ranges", "RMSE (m)", "rank gap"]
    yield Table("A semidefinite program (Clarabel), without NLOS", header, rows, 2)


def _diffusion(results: Results) -> Table:
    rows = []
    for variant in (W.sparse(2000.0), W.speed(plan.MODERATE)):
        found: Diffusion | None = results.get(variant.key, HUBER, DIFFUSION)
        for k, shares in ({} if found is None else found.by_hops()).items():
            assert found is not None
            cells = [f"{k}", f"{len(shares)}", number(shares.mean(), "{:.4f}")]
            cells += [number(shares.max(), "{:.3f}")]
            rows.append([variant.title, f"{found.degree:.1f}", *cells])
    header = ["worlds", "degree", "hops", "pairs", "moved, of the fix's error", "at most"]
    return Table("Equations 9 and 10: an anchor's wrong fix, by hops from it", header, rows, 1)


def _settings(results: Results) -> Table:
    rows = []
    for variant in _set_in(W):
        there = results.runs(variant.key, list(SETTINGS))
        alone = there.get(PAPERS_OPTIMIZER)
        for agent, one in there.items():
            gain = "" if alone in (None, one) else signed(gain_in(rmse)(one, alone), "")
            cells = [SETTINGS[agent], with_ends(rmse, "{:.2f}")(one), gain]
            rows.append([variant.title, f"`{agent}`", *cells])
    header = ["worlds", "agent", "what", "RMSE (m)", "better than the first (%)"]
    return Table("The optimizer's settings, and equation 36 by its gain κ", header, rows, 3)


def drawn(results: Results) -> Figure | None:
    """(a) Errors over time and theorem 1's bound (dashed) from each method's own α and w, v_max 100
    m/s. (b) How far an anchor's wrong fix moves others, by hops from it: mean and largest, of the
    fix's error."""
    there = results.runs(W.speed(plan.FAST).key, [WORLD, *WATCHED])
    there = {agent: one for agent, one in there.items() if theory.settles(one)}
    spread = {
        v.title: results.get(v.key, HUBER, DIFFUSION)
        for v in (W.sparse(2000.0), W.speed(plan.MODERATE))
    }
    spread = {title: found for title, found in spread.items() if found is not None}
    if not there and not spread:
        return None
    figure, ((time, hops),) = panels(1, 2, (11.0, 4.2), "How errors accumulate and spread")
    for i, (agent, one) in enumerate(there.items()):
        (error, bound), style = (x.mean(0) for x in theory.bounded(one)), style_of(agent, i)
        at = one.dt * np.arange(one.steps - len(error), one.steps)
        time.plot(at, error, **style)
        time.plot(at, bound, "--", color=style["color"], linewidth=0.9)
    time.set(xlabel="time (s)", ylabel="RMSE (m)", title="a")
    log(time)
    for i, (title, found) in enumerate(spread.items()):
        each = found.by_hops()
        colour = ("#0072B2", "#D55E00")[i % 2]
        hops.plot(list(each), [x.mean() for x in each.values()], "o-", color=colour, label=title)
        hops.plot(list(each), [x.max() for x in each.values()], ":", color=colour)
    hops.set(xlabel="hops", ylabel="moved, of the fix's error", title="b", yscale="log")
    legend(figure, [time, hops], 5)
    return figure


FIGURES = {"theory.png": drawn}
