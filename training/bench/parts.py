"""Where the time of a localizer's step goes: its parts' own time, by watching the calls.

Parts are named where they are looked up, so a renamed function must be renamed here too;
``missing_parts`` names those that are gone, and a test fails for them.
"""

import pkgutil
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import torch

from agents import Localizer
from coloc_env.scenario import Scenario
from training.evaluation.rollout import rollout

PROFILED = ("ekf", "ekf_trust", "apf", "pfnn", "pf_trust")
REST = "rest"
_STEPS, _WARM_UP = 200, 20
_FUNCTIONS = {  # where a name is looked up: what its time is called
    "agents.particle.update.normal": "noise",
    "agents.particle.resampling.normal": "noise",
    "agents.particle.proposal.normal": "noise",
    "agents.particle.tempering.normal": "noise",
    "agents.particle.filter.received": "messages",
    "agents.particle.update.log_likelihood": "likelihood",
    "agents.particle.resampling.moments": "moments",
    "agents.particle.proposal.moments": "moments",
    "agents.particle.tempering.moments": "moments",
    "agents.particle.resampling.systematic": "resampling",
    "agents.particle.resampling.liu_west": "resampling",
    "agents.particle.resampling.normalized": "weights",
    "agents.particle.degeneracy.effective_sample_size": "weights",
    "agents.particle.proposal.normalized": "weights",
    "agents.particle.tempering.normalized": "weights",
    "agents.particle.tempering.effective_sample_size": "weights",
    "agents.particle.proposal.iterated_update": "Gaussian update",
    "agents.particle.update.draw": "proposal",
    "agents.particle.degeneracy.draw": "proposal",
    "agents.kalman.ekf.received": "messages",
    "agents.kalman.filter.predict": "prediction",
    "agents.models.update.information": "information",
    "agents.models.update.posterior": "information",
    "agents.trust.screen.innovation": "trust features",
    "agents.trust.screen.features": "trust features",
    "agents.trust.screen.huber_weights": "Huber weights",
    "agents.bank.branches.huber_weights": "Huber weights",
    "agents.bank.scored.predictive_score": "predictive score",
}
_METHODS = {  # of a localizer and what it is made of
    "process.propagate": "prediction",
    "resampling.weigh": "weights",
    "resampling.resample_few": "resampling",
    "log_correction": "corrector network",
    "filter.screen.candidate.network.trust_vectors": "trust networks",
    "filter.screen.candidate.network.trust_ranges": "trust networks",
    "candidate.screen.screen.screen.network.trust_vectors": "trust networks",
    "candidate.screen.screen.screen.network.trust_ranges": "trust networks",
    "candidate.resampling.weigh": "weights",
    "candidate.resampling.resample_few": "resampling",
}


class Stopwatch:
    """Own time of watched calls, in seconds by part: a part within a part is taken off it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.inner = [0.0]

    def watched(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its own time put down under ``part``."""

        def call(*args: Any, **named: Any) -> Any:
            self.inner.append(0.0)
            start = time.perf_counter()
            try:
                return function(*args, **named)
            finally:
                whole = time.perf_counter() - start
                self.seconds[part] += whole - self.inner.pop()
                self.inner[-1] += whole

        return call


def step_parts(localizer: Localizer, scenario: Scenario) -> dict[str, float]:
    """Mean ms of each part of the whole team's step in one world; ``rest`` is what no part is."""
    watch = Stopwatch()
    with (
        _watching(localizer, watch),
        patch.object(localizer, "step", watch.watched(REST, localizer.step)),
    ):
        for step in rollout(localizer, scenario, torch.tensor([0]), _WARM_UP + _STEPS):
            if step.k == _WARM_UP - 1:
                watch.seconds.clear()
    ordered = sorted(watch.seconds.items(), key=lambda item: (item[0] == REST, -item[1]))
    return {part: 1e3 * seconds / _STEPS for part, seconds in ordered}


def missing_parts(localizers: Iterable[Localizer]) -> list[str]:
    """Names of parts that there are no more: functions, and methods that no localizer has."""
    gone = []
    for path in _FUNCTIONS:
        try:
            pkgutil.resolve_name(path)
        except (ImportError, AttributeError):
            gone.append(path)
    every = list(localizers)
    gone += [path for path in _METHODS if all(_owner(one, path) is None for one in every)]
    return gone


def _owner(localizer: Localizer, path: str) -> Any:
    """The object whose method ``path`` names, from the localizer on; None if it has none."""
    *owners, name = path.split(".")
    owner: Any = localizer
    for one in owners:
        owner = getattr(owner, one, None)
    return owner if hasattr(owner, name) else None


@contextmanager
def _watching(localizer: Localizer, watch: Stopwatch) -> Iterator[None]:
    """Every known part replaced by its watched self."""
    with ExitStack() as stack:
        for path, part in _FUNCTIONS.items():
            mock = patch(path)
            original, _ = mock.get_original()
            stack.enter_context(patch(path, watch.watched(part, original)))
        for path, part in _METHODS.items():
            owner, name = _owner(localizer, path), path.split(".")[-1]
            if owner is not None:
                watched = watch.watched(part, getattr(owner, name))
                stack.enter_context(patch.object(owner, name, watched))
        for model in getattr(localizer, "models", ()):
            watched = watch.watched("linearization", model.linearize)
            stack.enter_context(patch.object(model, "linearize", watched))
        yield
