"""What learners wait for: each route's environment, and training included."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from agents.wrappers.correction import learners_mode
from coloc_env.envs.per_uav import PerUavEnv
from coloc_env.envs.pettingzoo import parallel_env
from coloc_env.envs.sb3 import CoLocVecEnv
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenarios import make_scenario
from training.bench.cases import Case, Timed
from training.learning import mappo as _mappo  # noqa: F401  (registers its trainings)
from training.learning import sb3_ppo as _sb3_ppo  # noqa: F401
from training.learning.registry import TRAININGS

WORLDS, HORIZON = 64, 50
_SCENE = make_scenario("indoor-v0", motion="random", horizon=HORIZON)
_BASES = {"displacement": "none", "corrects ekf": "ekf"}


def learning_cases() -> Iterator[Case]:
    """Six UAVs, alone and as corrections on an EKF; with training, a feed-forward policy."""
    agents = 6 * WORLDS
    yield Case("learning", "PettingZoo, displacement", 6, HORIZON, _pettingzoo)
    for what, base in _BASES.items():
        yield Case("learning", f"TorchRL, {what}", agents, HORIZON, _per_uav(base))
        yield Case("learning", f"VecEnv, {what}", agents, HORIZON, _vec_env(base))
        yield Case("training", f"TorchRL ippo, {what}", agents, HORIZON, _trained("ippo", base))
        yield Case("training", f"SB3 PPO, {what}", agents, HORIZON, _trained("sb3-ppo", base))


def _pettingzoo() -> Timed:
    env = parallel_env(_SCENE, action="displacement")
    actions = {agent: np.zeros(3, np.float32) for agent in env.possible_agents}

    def run(steps: int) -> None:
        for _ in range(steps // HORIZON):
            env.reset(seed=0)
            while env.agents:
                env.step(actions)

    return Timed(run, HORIZON)


def _per_uav(base: str) -> Callable[[], Timed]:
    def setup() -> Timed:
        env = PerUavEnv(CoLocEnv(_SCENE, WORLDS, action=learners_mode(_SCENE.believed, base)))

        def run(steps: int) -> None:
            env.rollout(steps, break_when_any_done=False)

        return Timed(run, HORIZON)

    return setup


def _vec_env(base: str) -> Callable[[], Timed]:
    def setup() -> Timed:
        env = CoLocVecEnv(_SCENE, WORLDS, action=learners_mode(_SCENE.believed, base))
        env.reset()
        actions = np.zeros((env.num_envs, 3), np.float32)

        def run(steps: int) -> None:
            for _ in range(steps):
                env.step(actions)

        return Timed(run, HORIZON)

    return setup


def _trained(name: str, base: str) -> Callable[[], Timed]:
    def setup() -> Timed:
        options: dict[str, Any] = {"recurrent": False} if name == "ippo" else {}
        training = TRAININGS[name](
            scenario=f"indoor-v0:motion=random:horizon={HORIZON}",
            base=base,
            worlds=WORLDS,
            epochs=1,
            score_runs=0,
            **options,
        )
        training.trainer.logger = _Silent()

        def run(steps: int) -> None:
            for _ in range(steps // HORIZON):
                training.collector.epoch = 0
                training.trainer.train()

        return Timed(run, HORIZON)

    return setup


class _Silent:
    """A logger that keeps nothing."""

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """Forget it."""
