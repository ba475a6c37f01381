"""The paper's claims, and what our runs say of them."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from coloc_env.bounds import Bound
from training.evaluation.metrics import Difference, Floats
from training.reproduce.cost import Cost
from training.reproduce.stdcl import plan
from training.reproduce.stdcl.flown import Flown
from training.reproduce.stdcl.links import LOW
from training.reproduce.stdcl.measures import Runs, better, paired
from training.reproduce.stdcl.plan import (
    HUBER,
    LEARNED,
    OPEN,
    OPTIMIZER,
    PAPERS_FEEDBACK,
    RIVALS,
    SNAPSHOT,
    UNFED,
    WHOLE,
    Plan,
)
from training.reproduce.verdicts import (
    Claim,
    Verdict,
    away_from_zero,
    decide,
    gain,
    interval,
    least,
)

NEAR = 10.0  # per cent: as near as this counts as "close to", "not much different"
SHARPLY = 100.0  # per cent: from 20 % NLOS to 50 %, our reading of "sharply"
USABLE = 0.08  # NRMSE
DEADLINE = 100.0  # ms: 10 Hz
AT_ONCE = 0.15  # s
Need = tuple[str, str]  # a variant's key; an agent, a bound, or a cost


class Case(NamedTuple):
    """A claim, what it takes, and the figure of ours that decides it."""

    claim: Claim
    needs: tuple[Need, ...]
    figure: Callable[..., Difference]


def verdicts(flown: Flown, the: Plan, parts: tuple[str, ...]) -> list[Verdict]:
    """The claims of some parts, decided; one for which something is missing is not measured."""
    by_part = {"paper": paper, "stress": stress, "learned": loop, "campus": campus}
    judged = []
    for part in parts:
        for claim, needs, figure in by_part.get(part, lambda _: iter(()))(the):
            there = [flown.find(*need) for need in needs]
            absent = [need for need, found in zip(needs, there, strict=True) if found is None]
            if absent:
                judged.append(decide(claim, None, _not_there(absent)))
            else:
                judged.append(decide(claim, figure(*there)))
    if "campus" in parts:
        judged += link_verdicts(flown)
    return judged


# ------------------------------------------------------------------ sections 5.2 to 5.6


def paper(the: Plan) -> Iterator[Case]:
    """Simulations without stress."""
    for v_max, theirs in ((plan.FAST, 0.0077), (plan.MODERATE, 0.0068)):
        key, at = the.speed(v_max).key, f"v_max {v_max:g}"
        claim = Claim(f"{at}: average NRMSE", f"{theirs}", "", "below", theirs)
        yield Case(claim, ((key, WHOLE),), lambda x: interval(x.nrmse))
        claim = Claim(f"{at}: ST-DCL is the best of the five", "optimal", "%", "above")
        yield _best(claim, (key,))
    key = the.speed(plan.MODERATE).key
    claim = Claim(
        "v_max 50: NRMSE better than the state of the art's", "21 %", "%", "above", size=21.0
    )
    yield _best(claim, (key,))
    claim = Claim("v_max 50: error below dwMDS's", "66 %", "%", "above", size=66.0)
    yield Case(claim, ((key, WHOLE), (key, "dwmds")), better)
    for name in ("random", "u", "o"):
        key = the.layout(name).key
        claim = Claim(
            f"{name} layout: MDS-MAP's error is much larger (here: at least twice)",
            "much larger",
            "%",
            "above",
            50.0,
        )
        yield Case(claim, ((key, WHOLE), (key, "mds")), better)
    keys = tuple(the.radius(metres).key for metres in plan.RADII)
    claim = Claim("ST-DCL is best at every radius", "optimal", "%", "above")
    yield _best(claim, keys)
    claim = Claim("NRMSE falls as the radius grows, at every step", "decreases", "%", "above")
    yield Case(claim, tuple((key, WHOLE) for key in keys), _falling)
    at = the.radius(3500.0).key
    claim = Claim(
        f"R = 3500 m: close to the CRLB of a snapshot (here: within {NEAR:g} %)",
        "close",
        "%",
        "below",
        NEAR,
    )
    yield Case(claim, ((at, WHOLE), (at, SNAPSHOT)), _off_bound)
    for metres in plan.RADII:
        if metres > 2500.0:
            key = the.radius(metres).key
            claim = Claim(
                f"R = {metres:g} m: vMDS about as good as ST-DCL (here: within {NEAR:g} %)",
                "not much different",
                "%",
                "below",
                NEAR,
            )
            yield Case(claim, ((key, WHOLE), (key, "vmds")), _apart)
    key = the.timed(200).key
    claim = Claim("time of ST-DCL against dwMDS's", "+28.6 %", "%", "below", 28.6)
    yield Case(claim, ((key, f"ms:{WHOLE}"), (key, "ms:dwmds")), _dearer)
    claim = Claim("time of MDS-MAP as a multiple of ST-DCL's", "2.6", "", "above", 1.0, 2.6)
    yield Case(claim, ((key, "ms:mds"), (key, f"ms:{WHOLE}")), _times)
    claim = Claim("N = 200 within 10 Hz's 100 ms", "36 to 42 ms", "ms", "below", DEADLINE)
    yield Case(claim, ((key, f"ms:{WHOLE}"),), lambda x: interval(x.ms))


# ------------------------------------------------------------------ section 5.7


def stress(the: Plan) -> Iterator[Case]:
    """NLOS, sparse networks and links that fail."""
    usual, many = the.share(0.2).key, the.share(0.5).key
    heavy = the.tail(0.5).key
    for key, name in ((many, "NLOS 50 %"), (heavy, "mixture 50 %")):
        claim = Claim(f"{name}: ST-DCL's NRMSE stays usable", f"< {USABLE:g}", "", "below", USABLE)
        yield Case(claim, ((key, WHOLE),), lambda x: interval(x.nrmse))
        yield _best(Claim(f"{name}: ST-DCL is the best of the five", "best", "%", "above"), (key,))
    for agent, name in (("dwmds", "dwMDS"), (LEARNED, "pure learning")):
        claim = Claim(
            f"NLOS 20 to 50 %: {name} degrades sharply (here: twice the error)",
            "sharply",
            "%",
            "above",
            SHARPLY,
        )
        yield Case(claim, ((many, agent), (usual, agent)), _risen)
    claim = Claim(
        "NLOS 20 to 50 %: ST-DCL's error increases gradually (here: less than twice)",
        "gradually",
        "%",
        "below",
        SHARPLY,
    )
    yield Case(claim, ((many, WHOLE), (usual, WHOLE)), _risen)
    sparse, dense = the.sparse(plan.SPARSE[0]).key, the.share(0.15).key
    yield _best(
        Claim("degree 2.5: ST-DCL is the best of the five", "lowest", "%", "above"), (sparse,)
    )
    claim = Claim("degree 2.5: MDS-MAP degrades most", "most pronounced", "m", "above")
    needs = tuple((key, agent) for agent in (*RIVALS, WHOLE) for key in (sparse, dense))
    yield Case(claim, needs, _most)
    failing = the.failing(plan.FAILURES[0]).key
    claim = Claim(
        "links failing 25 %: ST-DCL is the best of the five", "significantly", "%", "above"
    )
    yield _best(claim, (failing,))
    claim = Claim(
        "links failing 25 %: ST-DCL is the steadiest over time", "more stable", "%", "above"
    )
    needs = tuple((failing, agent) for agent in (WHOLE, *RIVALS))
    yield Case(
        claim, needs, lambda x, *rivals: least([(x.restless(), r.restless()) for r in rivals])
    )
    for share in (0.15, 0.5):
        key = the.share(share).key
        paper_, none = (f"{OPTIMIZER}:confidence={c}" for c in ("paper", "none"))
        claim = Claim(
            f"NLOS {100 * share:g} %: the paper's confidence isolates outliers (here: it takes half"
            " the error off)",
            "effective isolation",
            "%",
            "above",
            50.0,
        )
        yield Case(claim, ((key, paper_), (key, none)), better)
        claim = Claim(
            f"NLOS {100 * share:g} %: Huber's loss takes half the error off",
            "first layer of robust estimation",
            "%",
            "above",
            50.0,
        )
        yield Case(claim, ((key, HUBER), (key, none)), better)


# ------------------------------------------------------------------ the loop


def loop(the: Plan) -> Iterator[Case]:
    """What closing the loop does."""
    for key in (the.speed(plan.MODERATE).key, the.held_out()["weave"].key):
        where = the.speed(plan.MODERATE).title if key.startswith("v") else "held-out manoeuvres"
        claim = Claim(f"{where}: the paper's feedback lowers the error", "quickly", "%", "above")
        yield Case(claim, ((key, PAPERS_FEEDBACK), (key, UNFED)), better)
        claim = Claim(f"{where}: the loop as trained here lowers it", "quickly", "%", "above")
        yield Case(claim, ((key, WHOLE), (key, OPEN)), better)
        claim = Claim(
            f"{where}: correcting an optimizer's input with a network trained in open loop is safe",
            "bounded convergence",
            "%",
            "above",
            -3.0,
        )
        yield Case(claim, ((key, plan.CLOSED_AFTERWARDS), (key, OPTIMIZER)), better)
    key = the.long().key
    claim = Claim(
        "1000 steps: the last hundred against steps 10 to 110", "stable", "", "below", 1.1
    )
    yield Case(claim, ((key, WHOLE),), lambda x: interval(x.drift()))


# ------------------------------------------------------------------ section 6


def campus(the: Plan) -> Iterator[Case]:
    """Flights about a building."""
    others = ("mds", "dwmds", "vmds", LEARNED)
    for name in plan.FLIGHTS:
        key = the.flight(name).key
        claim = Claim(f"{name.upper()}: ST-DCL has the lowest FGE", "best", "%", "above")
        needs = tuple((key, agent) for agent in (WHOLE, *others))
        yield Case(claim, needs, _lowest_fge)
    key = the.flight("s2").key
    for agent, theirs in (("dwmds", 3.01), ("vmds", 2.45)):
        words = f"S2: FGE below {agent}'s"
        claim = Claim(
            words, f"1.52 m against {theirs}", "%", "above", size=100 * (1 - 1.52 / theirs)
        )
        yield Case(claim, ((key, WHOLE), (key, agent)), lambda a, b: gain(*paired(a.fge, b.fge)))
    claim = Claim("S2: FGE of ST-DCL", "1.52 m", "m", "below", 1.52)
    yield Case(claim, ((key, WHOLE),), lambda x: interval(x.fge))
    claim = Claim("S2: ST-GAT does worse than vMDS", "underperforms", "%", "above")
    yield Case(claim, ((key, "vmds"), (key, LEARNED)), lambda a, b: gain(*paired(a.fge, b.fge)))
    claim = Claim(
        "ten UAVs within 10 Hz's 100 ms", "45 ms on a Jetson Nano", "ms", "below", DEADLINE
    )
    yield Case(claim, ((the.timed_flight().key, f"ms:{WHOLE}"),), lambda x: interval(x.ms))


def link_verdicts(flown: Flown) -> list[Verdict]:
    """Figure 14, of one link in one run: no interval, so the figure itself decides."""
    whole, plain = (flown.watched.get(agent) for agent in (WHOLE, f"{OPTIMIZER}:confidence=none"))
    event = None if whole is None else whole.event()
    falls = Claim(
        f"S2, one link: its weight falls below {LOW:g} at once", "in 150 ms", "s", "below", AT_ONCE
    )
    lower = Claim(
        "S2, one link: the peak of its UAVs' errors is suppressed", "significantly", "%", "above"
    )
    if whole is None or event is None:
        return [decide(each, None, "no such link") for each in (falls, lower)]
    time = whole.fall(event)
    judged = [decide(falls, Difference(time, time, time))]
    if plain is None:
        return [*judged, decide(lower, None, "not flown without weights")]
    less = 100 * (1 - whole.peak(event) / plain.peak(event))
    return [*judged, decide(lower, Difference(less, less, less))]


# ------------------------------------------------------------------ figures


def _not_there(absent: list[Need]) -> str:
    """What a claim lacks, by name."""
    agents = ", ".join(dict.fromkeys(what.removeprefix("ms:") for _, what in absent))
    places = list(dict.fromkeys(key for key, _ in absent))
    return f"not there: {agents} in {places[0]}{' and others' if len(places) > 1 else ''}"


def _best(claim: Claim, keys: tuple[str, ...]) -> Case:
    """The least of ST-DCL's gains on its rivals in some variants."""

    def figure(*runs: Runs) -> Difference:
        each = 1 + len(RIVALS)
        teams = [runs[i : i + each] for i in range(0, len(runs), each)]
        return least([paired(own.rmse, r.rmse) for own, *rivals in teams for r in rivals])

    return Case(claim, tuple((key, agent) for key in keys for agent in (WHOLE, *RIVALS)), figure)


def _falling(*runs: Runs) -> Difference:
    return least([paired(b.nrmse, a.nrmse) for a, b in pairwise(runs)])


def _apart(one: Runs, other: Runs) -> Difference:
    return away_from_zero(better(one, other))


def _risen(more: Runs, less: Runs) -> Difference:
    """By how many per cent the error has grown."""
    found = better(more, less)
    return Difference(-found.mean, -found.high, -found.low)


def _most(*runs: Runs) -> Difference:
    """The first method's rise in m less the largest of the others'; they come in pairs, sparse and
    dense."""
    rises: list[Floats] = [
        np.subtract(*paired(a.rmse, b.rmse)) for a, b in zip(runs[::2], runs[1::2], strict=True)
    ]
    own, *others = rises
    return min(
        (interval(own - each, 1 - 0.05 / len(others)) for each in others), key=lambda x: x.mean
    )


def _off_bound(runs: Runs, bound: Bound) -> Difference:
    """How far the RMSE of each of the bound's runs is from the bound, in per cent."""
    mse = np.where(bound.scored.numpy(), bound.mse.numpy(), 0.0)
    least_ = np.sqrt(mse.sum((1, 2)) / bound.scored.numpy().sum((1, 2)))
    own, least_ = paired(runs.rmse, least_)
    return away_from_zero(interval(100 * (own / least_ - 1)))


def _dearer(one: Cost, other: Cost) -> Difference:
    """By how many per cent steps take longer; both took each step in turn."""
    return interval(100 * (one.ms / other.ms - 1))


def _times(one: Cost, other: Cost) -> Difference:
    return interval(one.ms / other.ms)


def _lowest_fge(own: Runs, *others: Runs) -> Difference:
    return least([paired(own.fge, other.fge) for other in others])
