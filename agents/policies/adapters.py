"""A Localizer as a policy of either face: PettingZoo's dictionaries, TorchRL's tensordicts."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import TensorDictPrimer

from agents.localizer import Localizer
from coloc_env.observation import Observation, all_leaves, stack
from coloc_env.scenario import Scenario
from coloc_env.sensors.base import Layout
from coloc_env.world import World

CARRIES = ("module", "tensordict")
Record = Callable[[Any, Any, TensorDictBase], Mapping[str, Tensor]]


def check_part(localizer: Localizer, count: int) -> None:
    """Raise a ValueError if the localizer cannot act for only ``count`` UAVs of its team."""
    believed = localizer.believed
    if count == believed.arena.n_uavs:
        return
    why = ""
    if any(getattr(sensor, "tags", ()) for sensor in believed.sensors):
        why = "this team's UWB lever arms differ from UAV to UAV"
    elif localizer.exchanges:
        why = "the UAVs share what they measured"
    if why:
        raise ValueError(f"{localizer.name}: {why}, so one localizer must act for all of them")


class ParallelPolicy:
    """A localizer that acts in a PettingZoo parallel environment.

    In each step ``actions = policy({a: observations[a] for a in env.agents})``; call ``reset()``
    before every episode. (A new episode is noticed without: another prior or map, or no message
    where a link would have brought one. The same world again, with nobody linked, is not.)
    ``agents`` names the UAVs that this localizer estimates for (default: all that are there at the
    first call), so that a team can be a mixture: one policy a kind, their dictionaries merged. A
    UAV that has failed keeps its row, silent and without measurements, and gets no action.
    """

    def __init__(self, localizer: Localizer, agents: Sequence[str] | None = None) -> None:
        self.localizer = localizer
        self.agents = None if agents is None else tuple(agents)
        believed = localizer.believed
        layout = Layout(believed.arena, believed.slots)
        self._constant = {"prior"}.union(*(s.map_leaves(layout) for s in believed.sensors))
        self.reset()

    def reset(self) -> None:
        """Forget the episode."""
        self._belief: Any = None
        self._steps = 0
        self._rows: dict[str, Mapping[str, np.ndarray]] = {}

    @torch.no_grad()
    def __call__(
        self, observations: Mapping[str, Mapping[str, np.ndarray]]
    ) -> dict[str, np.ndarray]:
        """Actions ``[position (m), velocity (m/s), log-std]`` of the observed agents.

        Raises ValueError for what is not the team's observations, such as those of one agent at a
        time in PettingZoo's agent-environment cycle.
        """
        self._require_team(observations)
        if self._restarted(observations):
            self.reset()
        first = not self._steps
        team = (self.agents or tuple(observations)) if first else tuple(self._rows)
        present = [agent for agent in team if agent in observations]
        if first:
            if len(present) < len(team):
                missing = next(agent for agent in team if agent not in observations)
                raise ValueError(f"{self.localizer.name}: the episode's first step lacks {missing}")
            check_part(self.localizer, len(team))
        if not present:
            return {}
        for agent in team:
            own = observations.get(agent)
            self._rows[agent] = self._silent(self._rows[agent]) if own is None else _copy(own)
        observation = stack(self._rows.values())
        if first:
            self._belief = self.localizer.reset(observation)
        self._belief, estimate = self.localizer.step(self._belief, observation)
        self._steps += 1
        actions = dict(zip(team, estimate.action()[0].numpy(), strict=True))
        return {agent: actions[agent] for agent in present}

    def _require_team(self, observations: Mapping[str, Mapping[str, np.ndarray]]) -> None:
        """Raise ValueError unless these are observations by agent, of the agents known."""
        name = self.localizer.name
        if not all(isinstance(own, Mapping) for own in observations.values()):
            raise ValueError(
                f"{name}: {{agent: observation}} of all its UAVs is needed, as the parallel "
                "environment gives it; an AEC environment's last() is of one agent"
            )
        known = self.agents or tuple(self._rows)
        strange = [agent for agent in observations if agent not in known]
        if known and self.agents is None and strange:
            raise ValueError(
                f"{name}: {strange[0]} was not there at the episode's first step, which had "
                f"{', '.join(known)}; observations of the whole team are needed at once, not one "
                "agent's at a time as in an AEC environment"
            )

    def _restarted(self, observations: Mapping[str, Mapping[str, np.ndarray]]) -> bool:
        """Whether observations are of another episode than those before."""
        if not self._steps:
            return False
        late = self._steps > self.localizer.believed.message_delay
        for agent, before in self._rows.items():
            own = observations.get(agent)
            if own is None:
                continue
            if any(not np.array_equal(own[name], before[name]) for name in self._constant):
                return True
            if late and own["links"].any() and not own["message_mask"].any():
                return True
        return False

    def _silent(self, row: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What a failed UAV observes: its maps and prior; no measurement, link or message."""
        return {
            name: leaf if name in self._constant else np.zeros_like(leaf)
            for name, leaf in row.items()
        }


def _copy(leaves: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: np.array(leaf) for name, leaf in leaves.items()}


class LocalizerPolicy(TensorDictModuleBase):
    """A localizer as a TorchRL policy: ``("uav", "observation", leaf)`` → ``("uav", "action")``.

    Rows restart where ``is_init`` is set, which ``InitTracker`` writes. The belief stays in the
    module, which is then good for one environment at a time, or, with ``carry="tensordict"``, rides
    in the tensordict under ``belief`` (whose transform is ``make_tensordict_primer()``); then the
    module has no state. ``Collector(…, auto_register_policy_transforms=True)`` adds both transforms
    by itself; by hand: ``TransformedEnv(env, InitTracker())``.

    ``record(belief, belief_after, tensordict)`` is called after every step, the action written, and
    gives entries [B, …] for training, which go under ``("train", name)``.

    ``gradients=True``: the localizer's network is a part of the module, and actions, and with them
    any loss, have gradients by its parameters, through the belief over all steps since it was last
    detached. Raises ValueError for a localizer without a network.
    """

    def __init__(
        self,
        localizer: Localizer,
        scenario: Scenario,
        carry: str = "module",
        record: Record | None = None,
        gradients: bool = False,
    ) -> None:
        if carry not in CARRIES:
            raise ValueError(f"carry={carry!r} is not allowed: one of {', '.join(CARRIES)}")
        network = getattr(localizer, "network", None)
        if gradients and not isinstance(network, nn.Module):
            raise ValueError(f"gradients=True: {localizer.name} has no network of its own")
        super().__init__()
        self.network: nn.Module | None = network if gradients else None
        self.localizer = localizer
        self.scenario = scenario
        self.carry = carry
        self.record = record
        self._leaves = tuple(all_leaves(scenario))
        self._belief: Any = None
        self.in_keys = [("uav", "observation", name) for name in self._leaves] + ["is_init"]
        self.out_keys = [("uav", "action")]
        if carry == "tensordict":
            self.in_keys.append("belief")
            self.out_keys.append(("next", "belief"))
            self._template = self._sample_belief()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        with torch.set_grad_enabled(torch.is_grad_enabled() and self.network is not None):
            return self._step(tensordict)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        restarts = tensordict.get("is_init", None)
        if restarts is None:
            raise KeyError(
                "LocalizerPolicy needs 'is_init': wrap the environment in "
                "TransformedEnv(env, InitTracker())"
            )
        seen = tensordict["uav", "observation"]
        observation = Observation({name: seen[name] for name in self._leaves})
        belief = self._belief
        if self.carry == "tensordict":
            belief = restored(self._template, tensordict["belief"], observation.batch_size)
        belief = self._start(belief, observation, restarts.flatten())
        after, estimate = self.localizer.step(belief, observation)
        tensordict["uav", "action"] = estimate.action()
        if self.record is not None:
            for name, value in self.record(belief, after, tensordict).items():
                tensordict["train", name] = value
        if self.carry == "tensordict":
            tensordict["next", "belief"] = flat(after)
        else:
            self._belief = after
        return tensordict

    def _start(self, belief: Any, observation: Observation, rows: Tensor) -> Any:
        """The belief, with the rows marked at their prior."""
        if belief is None or belief.batch_size != observation.batch_size or bool(rows.all()):
            return self.localizer.reset(observation)
        if not bool(rows.any()):
            return belief
        fresh = self.localizer.reset(observation)
        return fresh.where(rows.unsqueeze(-1).expand(observation.batch_size), belief)

    def _sample_belief(self) -> Any:
        """A belief of one world, for names, shapes and types."""
        return self.localizer.reset(World(self.scenario, window=1).reset(0))

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that makes room in tensordicts for what the policy carries there."""
        carried = self.carry == "tensordict"
        entries = {"belief": _spec(flat(self._template))} if carried else {}
        return TensorDictPrimer(entries, expand_specs=True)


def flat(belief: Any) -> TensorDict:
    """A belief's entries, nested names joined by dots, with a batch size of worlds alone (so that
    the primer's zeros and the policy's beliefs have one shape)."""
    entries = belief.to_tensordict(retain_none=False).flatten_keys(".")
    return TensorDict(dict(entries.items()), batch_size=belief.batch_size[:1])


def restored(template: Any, entries: TensorDictBase, batch_size: torch.Size) -> Any:
    """A belief from what a policy that carries it in tensordicts has written there: ``entries`` as
    the tensorclass of ``template``, nested ones included."""
    values = {
        name: value
        if isinstance(value, Tensor)
        else restored(getattr(template, name), value, batch_size)
        for name, value in entries.unflatten_keys(".").items()
    }
    return type(template)(**values, batch_size=batch_size)


def _spec(flat: TensorDict) -> Composite:
    """Specs of a belief's entries without the dimension of worlds."""
    return Composite(
        {
            name: Binary(shape=value.shape[1:], dtype=torch.bool)
            if value.dtype == torch.bool
            else Unbounded(shape=value.shape[1:], dtype=value.dtype)
            for name, value in flat.items()
        }
    )
