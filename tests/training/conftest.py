"""A tiny localizer for the tests, registered while a module of them runs, and made-up results."""

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate, Localizer
from agents.registry import LOCALIZERS
from coloc_env.motion import MOTIONS, Arena
from coloc_env.network import Network
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, ConstantVelocity, Prior, Scenario
from training.evaluation.record import RunRecord, Worlds
from training.evaluation.results import Evaluation

sys.path.insert(0, str(Path(__file__).parent))  # units.py, also for processes that tests start


class Belief(TensorClass["nocast"]):
    position: Tensor
    step: Tensor


class Still(Localizer[Belief]):
    """The prior's mean, moved by ``offset`` m along x and y a step; wrong in the ways asked for.

    From step ``at`` on, in worlds whose first UAV's prior lies at x < ``west`` m: ``nan`` says NaN,
    ``huge`` 10³⁵ m, ``raises`` raises RuntimeError, ``missing`` raises NotImplementedError.
    """

    name = "test_still"

    def __init__(
        self,
        believed: Believed,
        *,
        offset: float = 0.0,
        std: float = 2.0,
        wrong: str = "",
        at: int = 0,
        west: float = 1e9,
    ) -> None:
        super().__init__(believed)
        self.offset, self.std, self.wrong, self.at, self.west = offset, std, wrong, at, west

    def reset(self, observation: Observation) -> Belief:
        shape, dim = observation.batch_size, self.believed.arena.dim
        position = observation["prior"][..., :dim].clone()
        step = torch.zeros(shape, dtype=torch.int64)
        return Belief(position=position, step=step, batch_size=shape)

    def step(self, belief: Belief, observation: Observation) -> tuple[Belief, Estimate]:
        shape, now = belief.batch_size, int(belief.step[0, 0])
        position = belief.position.clone()
        position[..., :2] += self.offset
        stated = position.clone()
        struck = (observation["prior"][:, :1, 0] < self.west) & (now >= self.at)
        if self.wrong == "nan":
            stated[:, :1][struck] = torch.nan
        elif self.wrong == "huge":
            stated[:, :1][struck] = 1e35
        elif self.wrong == "missing":
            raise NotImplementedError("not there yet")
        elif self.wrong == "raises" and bool(struck.any()):
            raise RuntimeError("the matrix is singular")
        covariance = torch.eye(position.shape[-1]).expand(*position.shape, -1) * self.std**2
        estimate = Estimate(
            position=stated,
            velocity=torch.zeros_like(position),
            covariance=covariance,
            batch_size=shape,
        )
        return Belief(position=position, step=belief.step + 1, batch_size=shape), estimate

    def diagnostics(self, belief: Belief) -> dict[str, Tensor]:
        calm = torch.ones(belief.batch_size)
        return {"particles": belief.step + 99.0, "calm": calm, "steps_per_run": calm}


def _arrays(dim: int) -> Evaluation:
    """Evaluation of two agents without a simulation; the second is hopeless."""
    rng = np.random.default_rng(0)
    runs, steps, n_uavs = 2, 30, 3
    arena = Arena(dim, n_uavs, 0.1, (0.0,) * dim, (10.0,) * dim)
    shape = (runs, steps, n_uavs)
    offsets = {"good:weights=a/b": 0.1, "bad": 1e6}
    scenario = Scenario(
        name="made-up",
        arena=arena,
        horizon=steps,
        motion=MOTIONS["square"],
        sensors=(),
        network=Network(),
        prior=Prior(),
        process=ConstantVelocity(),
        believed_sensors=(),
        overrides={"room": (10.0, 10.0), "walls": None},
    )
    offset_of = {
        name: rng.normal(scale=scale, size=(*shape, dim)).astype(np.float32)
        for name, scale in offsets.items()
    }
    scored = np.ones(shape, bool)
    scored[0, 5:8] = False  # a gap in a recording
    scored[:, 20:, 0] = False  # a failed UAV
    attitude = rng.normal(size=(steps, n_uavs, 4 if dim == 3 else 1))
    attitude /= np.linalg.norm(attitude, axis=-1, keepdims=True) if dim == 3 else 1
    worlds = Worlds(7, rng.uniform(0, 10, size=(*shape, dim)), attitude, scored)
    agents = {
        name: RunRecord(
            worlds,
            offset,
            error=np.linalg.norm(offset, axis=-1),
            nees=(offset**2).sum(-1) / np.float32(0.01),
            broken=np.zeros(runs, bool),
            ms_per_step=1.5,
        )
        for name, offset in offset_of.items()
    }
    return Evaluation(scenario, worlds, None, agents)


@pytest.fixture(params=[2, 3])
def made_up(request: pytest.FixtureRequest) -> Evaluation:
    """Made-up results in two and three dimensions."""
    return _arrays(request.param)


@pytest.fixture(autouse=True, scope="module")
def localizers() -> Iterator[None]:
    """Registers ``test_still``, and takes it away again."""
    torch.set_num_threads(1)
    LOCALIZERS.register("test_still")(Still)
    yield
    LOCALIZERS.remove("test_still")


@pytest.fixture
def interrupted(
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[Any, str, int], AbstractContextManager[None]]:
    """``with interrupted(owner, name, call)``: inside, the so many-th call of a function or method
    is interrupted, and that must end what is done there."""

    @contextmanager
    def at(owner: Any, name: str, call: int) -> Iterator[None]:
        whole, calls = getattr(owner, name), 0

        def dies(*args: Any, **options: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls == call:
                raise KeyboardInterrupt
            return whole(*args, **options)

        with monkeypatch.context() as patch:
            patch.setattr(owner, name, dies)
            with pytest.raises(KeyboardInterrupt):
                yield

    return at
