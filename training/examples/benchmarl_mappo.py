"""BenchMARL's MAPPO on the TorchRL face, by displacements: a scenario as a BenchMARL task.

BenchMARL 1.5.2 wants an older TorchRL than coloc does, and coloc's environment runs with either. So
a virtual environment of its own, with both installed without what they depend on:

    python3.11 -m venv /tmp/benchmarl && . /tmp/benchmarl/bin/activate
    pip install torch==2.13.0 "torchrl==0.11.1" numpy tqdm hydra-core "av<14"
    pip install gymnasium pettingzoo jaxtyping pyyaml matplotlib scipy
    pip install --no-deps benchmarl==1.5.2 -e .
    python -m training.examples.benchmarl_mappo

Traps: all that ``observation_spec`` names goes into the policy; a frame is a step of the world, not
of a UAV; wandb, evaluation and files are on by default.
"""

import tempfile
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from benchmarl.algorithms import MappoConfig
from benchmarl.environments import TaskClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from torchrl.data import Composite
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from coloc_env import CoLocEnv


class CoLocTask(TaskClass):
    """A scenario as a BenchMARL task; its config: what ``CoLocEnv`` takes."""

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        return partial(CoLocEnv, self.name, num_envs, device, seed or 0, **self.config)

    def supports_continuous_actions(self) -> bool:
        return True

    def supports_discrete_actions(self) -> bool:
        return False

    def has_render(self, env: EnvBase) -> bool:
        return False

    def max_steps(self, env: EnvBase) -> int:
        return int(self.config["horizon"])

    def group_map(self, env: EnvBase) -> dict[str, list[str]]:
        return {"uav": list(env.scenario.agents)}

    def observation_spec(self, env: EnvBase) -> Composite:
        """What the policy reads: the leaves that the action mode recommends."""
        seen = env.full_observation_spec["uav", "observation"][0]
        leaves = Composite({name: seen[name] for name in env.mode.features}, shape=seen.shape)
        return Composite(uav=Composite(observation=leaves, shape=seen.shape))

    def state_spec(self, env: EnvBase) -> Composite:
        """The privileged truth, for MAPPO's critic; None: it sees all observations."""
        return Composite(state=env.full_observation_spec["state"][0])

    def action_spec(self, env: EnvBase) -> Composite:
        return env.full_action_spec[0]

    def action_mask_spec(self, env: EnvBase) -> None:
        return None

    def info_spec(self, env: EnvBase) -> None:
        return None

    @staticmethod
    def env_name() -> str:
        return "coloc"


@torch.no_grad()
def mean_error(policy: Any, settings: dict[str, Any]) -> float:
    """Mean error (m) of the best actions in 20 held-out worlds."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        env = CoLocEnv("indoor-v0", 20, seed=0, **settings)
        rollout = env.rollout(settings["horizon"], policy)
    return -float(rollout["next", "uav", "reward"].mean())


def main(
    iterations: int = 20, worlds: int = 60, horizon: int = 100, seed: int = 0
) -> dict[str, float]:
    torch.set_num_threads(1)
    settings = {"action": "displacement", "motion": "random", "horizon": horizon}
    config = ExperimentConfig.get_from_yaml()
    config.max_n_iters, config.max_n_frames = iterations, None
    config.on_policy_n_envs_per_worker = worlds
    config.on_policy_collected_frames_per_batch = frames = worlds * horizon
    config.on_policy_minibatch_size, config.on_policy_n_minibatch_iters = frames // 8, 4
    config.lr, config.gamma = 1e-3, 0.0  # an action's worth shows at once, in this step's error
    config.evaluation, config.loggers, config.create_json = False, [], False
    config.save_folder = tempfile.mkdtemp(prefix="coloc-benchmarl-")
    experiment = Experiment(
        task=CoLocTask("indoor-v0", settings),
        algorithm_config=MappoConfig.get_from_yaml(),
        model_config=MlpConfig.get_from_yaml(),
        seed=1_000_000 * (seed + 1),
        config=config,
    )
    before = mean_error(experiment.policy, settings)
    start = time.perf_counter()
    experiment.run()
    speed = iterations * frames * 6 / (time.perf_counter() - start)
    after = mean_error(experiment.policy, settings)
    print(f"mean error {before:.2f} m before, {after:.2f} m after")
    print(f"{speed:,.0f} agent-steps/s")
    return {"before": before, "after": after, "speed": speed}


if __name__ == "__main__":
    main()
