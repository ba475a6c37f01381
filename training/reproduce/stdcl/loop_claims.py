"""What the paper says of its loop, decided on it as printed and on the one trained here."""

from collections.abc import Iterator

from training.reproduce.settings import Settings
from training.reproduce.stdcl import plan
from training.reproduce.stdcl.claims import of
from training.reproduce.stdcl.measures import better, drift
from training.reproduce.stdcl.plan import (
    OPEN,
    OPTIMIZER,
    PAPERS_FEEDBACK,
    PAPERS_LEARNED,
    PAPERS_LOOP,
    PAPERS_OPTIMIZER,
    WHOLE,
    W,
)
from training.reproduce.verdicts import Claim, mean_of


def loop(settings: Settings) -> Iterator[Claim]:
    """What closing the loop does."""
    for variant in (W.speed(plan.MODERATE), W.lasting(0.15), W.lasting(0.5)):
        key, where = variant.key, variant.title
        claim = Claim(
            f"{where}: the feedback of equation 36 lowers the optimizer's error",
            "quickly",
            "%",
            "above",
        )
        yield of(claim, ((key, PAPERS_FEEDBACK), (key, PAPERS_OPTIMIZER)), better)
        claim = Claim(
            f"{where}: the network in that loop lowers it further", "compensates", "%", "above"
        )
        yield of(claim, ((key, PAPERS_LOOP), (key, PAPERS_FEEDBACK)), better)
        claim = Claim(
            f"{where}: equation 36 is at least as good as a feedback that is learned (here: within"
            " 3 %)",
            "closed loop",
            "%",
            "above",
            -3.0,
        )
        yield of(claim, ((key, PAPERS_LOOP), (key, PAPERS_LEARNED)), better)
    for key in (W.speed(plan.MODERATE).key, W.held_out()["weave"].key):
        where = W.speed(plan.MODERATE).title if key.startswith("v") else "held-out manoeuvres"
        claim = Claim(
            f"{where}: the loop as trained on calibrated weights lowers the error",
            "quickly",
            "%",
            "above",
        )
        yield of(claim, ((key, WHOLE), (key, OPEN)), better)
        claim = Claim(
            f"{where}: correcting an optimizer's input with a network trained in open loop is safe",
            "bounded convergence",
            "%",
            "above",
            -3.0,
        )
        yield of(claim, ((key, plan.CLOSED_AFTERWARDS), (key, OPTIMIZER)), better)
    key = W.long().key
    claim = Claim(
        "1000 steps: the last hundred against steps 10 to 110", "stable", "", "below", 1.1
    )
    yield of(claim, ((key, WHOLE),), mean_of(drift))
