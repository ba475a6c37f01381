"""BenchMARL's own command on the tasks: any of its algorithms and models, by Hydra.

In an environment of its own, which keeps coloc's torch (``benchmarl_mappo`` says why):

    python3.11 -m venv /tmp/benchmarl && . /tmp/benchmarl/bin/activate
    pip install torch==2.13.0 "torchrl==0.11.1" numpy tqdm hydra-core "av<14"
    pip install gymnasium pettingzoo jaxtyping pyyaml matplotlib scipy safetensors
    pip install --no-deps benchmarl==1.5.2 -e .
    python -m training.examples.benchmarl_tasks
    python -m training.examples.benchmarl_tasks algorithm=qmix task=coloc/schedule-v0 seed=1

The first line is MAPPO on ``survey-v0``. ``task.options`` are the task's, as ``coloc score`` takes
them, in quotes of their own (``"task.options='n_uavs=6:drift=0.2'"``); everything else is
BenchMARL's (``experiment.max_n_frames=2_000_000``). A frame is a step of the world; Hydra writes
into ``outputs/``.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarl.environments import TaskClass, task_config_registry
from hydra.core.config_store import ConfigStore
from torchrl.data import Composite
from torchrl.envs import EnvBase

from agents.tasks import TASKS, make_task
from agents.tasks.task import Task
from coloc_env import CoLocEnv


def environment(task: Task, num_envs: int, device: Any, seed: int | None) -> EnvBase:
    """Worlds of a task, on the TorchRL face."""
    return CoLocEnv(task.scenario, num_envs, device, seed or 0, task)


class CoLocTask(TaskClass):
    """A task of ours as one of BenchMARL's; its config: the task's ``options``."""

    def __init__(self, name: str, config: dict[str, Any]) -> None:
        super().__init__(name, config)
        options = self.config.get("options") or ""
        self.task = make_task(f"{name}:{options}" if options else name)

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        return partial(environment, self.task, num_envs, device, seed)

    def supports_continuous_actions(self) -> bool:
        return self.task.choices is None

    def supports_discrete_actions(self) -> bool:
        return self.task.choices is not None

    def has_render(self, env: EnvBase) -> bool:
        return False

    def max_steps(self, env: EnvBase) -> int:
        return self.task.scenario.horizon

    def group_map(self, env: EnvBase) -> dict[str, list[str]]:
        return dict(env.group_map)

    def observation_spec(self, env: EnvBase) -> Composite:
        seen = env.full_observation_spec["uav"][0]
        return Composite(
            uav=Composite(observation=seen["observation"], shape=seen.shape),
        )

    def state_spec(self, env: EnvBase) -> Composite:
        """The privileged truth, for critics and mixers."""
        return Composite(state=env.full_observation_spec["state"][0])

    def action_spec(self, env: EnvBase) -> Composite:
        return env.full_action_spec[0]

    def action_mask_spec(self, env: EnvBase) -> Composite | None:
        if self.task.choices is None:
            return None
        seen = env.full_observation_spec["uav"][0]
        return Composite(uav=Composite(action_mask=seen["action_mask"], shape=seen.shape))

    def info_spec(self, env: EnvBase) -> None:
        return None

    @staticmethod
    def env_name() -> str:
        return "coloc"


class Named:
    """A task's place in BenchMARL's registry."""

    def __init__(self, name: str) -> None:
        self.name = name

    def get_task(self, config: dict[str, Any] | None = None) -> CoLocTask:
        """The task with a config."""
        return CoLocTask(self.name, config or {})


def register() -> None:
    """Make every task known to BenchMARL and to its command, as ``coloc/NAME``."""
    for name in TASKS:
        task_config_registry[f"coloc/{name}"] = Named(name)
        ConfigStore.instance().store(name=name, group="task/coloc", node={"options": ""})


def main() -> None:
    from benchmarl.run import hydra_experiment

    register()
    if len(sys.argv) == 1:
        sys.argv += ["algorithm=mappo", "task=coloc/survey-v0"]
    hydra_experiment()


if __name__ == "__main__":
    main()
