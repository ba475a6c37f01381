"""The paper's own experiment: the corrector learns from the truth while it flies."""

from dataclasses import dataclass, replace

from agents.registry import make
from training.evaluation.evaluate import Progress
from training.evaluation.metrics import Floats
from training.learning.pfnn_online import learn_online
from training.reproduce.identity import code_of
from training.reproduce.store import Store
from training.reproduce.study import Piece, Variant

NAME = "pfnn, learning in flight"


@dataclass(frozen=True, eq=False)
class InFlight:
    """``error`` (m) and ``count`` of particles [R, K, N], ``loss`` [R, L] before each training."""

    error: Floats
    count: Floats
    loss: Floats


def learned(store: Store, variant: Variant, seed: int, runs: int, tell: Progress) -> InFlight:
    """All runs, from the store if they are there."""
    piece = Piece(variant, "pfnn", seed, runs)
    name = replace(piece, agent="pfnn-in-flight").name
    settings = piece.settings() | {
        "weights": "learned in flight",
        "code": code_of(make("pfnn", variant.build()), "training.learning.pfnn_online"),
    }
    if not store.has(name, settings):
        flown = learn_online(variant.build(), runs, seed, tell)
        arrays = {key: getattr(flown, key).numpy() for key in ("error", "count", "loss")}
        store.save(name, settings, arrays, {})
    arrays, _ = store.load(name, settings)
    return InFlight(**arrays)
