"""Sensing a window: truth, network and every sensor, for some rows over some steps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import rotate_by
from coloc_env.motion import Carry, Kinematics
from coloc_env.scenario import Prior, Scenario
from coloc_env.sensors.base import Window


@dataclass(frozen=True)
class Past:
    """Kinematics [R, H, N, …] of the last steps before a window: for increments and delays."""

    position: Tensor
    velocity: Tensor
    attitude: Tensor

    def map(self, f: Callable[[Tensor, Tensor], Tensor], other: "Past") -> "Past":
        return Past(
            f(self.position, other.position),
            f(self.velocity, other.velocity),
            f(self.attitude, other.attitude),
        )

    @staticmethod
    def cat(parts: Sequence["Past"]) -> "Past":
        return Past(
            torch.cat([p.position for p in parts]),
            torch.cat([p.velocity for p in parts]),
            torch.cat([p.attitude for p in parts]),
        )


@dataclass(frozen=True)
class Sensed:
    """A window of truth (float64) and leaves (float32): [R, K, N, …] each."""

    position: Float64[Tensor, "R K N d"]
    velocity: Float64[Tensor, "R K N d"]
    attitude: Float64[Tensor, "R K N a"]
    alive: Bool[Tensor, "R K N"]
    scored: Bool[Tensor, "R K N"]
    leaves: dict[str, Float32[Tensor, "R K N F"]]

    @property
    def count(self) -> int:
        """Steps in the window."""
        return self.position.shape[1]

    def neighbours(self, step: int) -> Int64[Tensor, "R N S"] | None:
        """UAV index of each slot; None where slot j is UAV j."""
        if "neighbours" not in self.leaves:
            return None
        return self.leaves["neighbours"][:, step].to(torch.int64)

    def map(self, f: Callable[[Tensor, Tensor], Tensor], other: "Sensed") -> "Sensed":
        return Sensed(
            f(self.position, other.position),
            f(self.velocity, other.velocity),
            f(self.attitude, other.attitude),
            f(self.alive, other.alive),
            f(self.scored, other.scored),
            {name: f(leaf, other.leaves[name]) for name, leaf in self.leaves.items()},
        )

    @staticmethod
    def cat(parts: Sequence["Sensed"]) -> "Sensed":
        return Sensed(
            torch.cat([p.position for p in parts]),
            torch.cat([p.velocity for p in parts]),
            torch.cat([p.attitude for p in parts]),
            torch.cat([p.alive for p in parts]),
            torch.cat([p.scored for p in parts]),
            {name: torch.cat([p.leaves[name] for p in parts]) for name in parts[0].leaves},
        )


def sense(
    scenario: Scenario,
    keys: Int64[Tensor, "R"],
    first: Int64[Tensor, "R"],
    count: int,
    carry: Carry,
    placed: Sequence[dict[str, Tensor]],
    fails_at: Int64[Tensor, "R N"],
    past: Past | None,
) -> tuple[Sensed, Carry, Past]:
    """Truth and measurements of R rows over ``count`` steps from each row's ``first`` on.

    ``past`` is None at step 0, where the steps before are taken to be like the first.
    """
    arena, network = scenario.arena, scenario.network
    steps = first.unsqueeze(-1) + torch.arange(count, device=keys.device)
    motion, carry = scenario.motion.advance(carry, steps, arena)
    delays = {sensor.delay for sensor in scenario.sensors} - {0}
    lead = max({1} | delays)
    if past is None:
        now = Past(motion.position[:, :1], motion.velocity[:, :1], motion.attitude[:, :1])
        past = now.map(lambda x, _: x.expand(-1, lead, *x.shape[2:]), now)
    whole = past.map(
        lambda x, y: torch.cat((x, y), 1), Past(motion.position, motion.velocity, motion.attitude)
    )

    def back(by: int) -> Kinematics:
        part = slice(lead - by, lead - by + count)
        return Kinematics(
            whole.position[:, part], whole.velocity[:, part], whole.attitude[:, part]
        )

    step_keys = noise.fold(keys.unsqueeze(-1), steps)
    alive = steps.unsqueeze(-1) < fails_at.unsqueeze(1)
    neighbours, reach = network.neighbours(motion.position, alive)
    window = Window(
        layout=scenario.layout,
        motion=motion,
        before=back(1),
        keys=step_keys,
        steps=steps,
        alive=alive,
        neighbours=neighbours,
        reach=reach,
        past={
            by: (back(by), noise.fold(keys.unsqueeze(-1), (steps - by).clamp_min(0)))
            for by in delays
        },
    )
    leaves: dict[str, Tensor] = {}
    for sensor, own in zip(scenario.sensors, placed, strict=True):
        leaves |= sensor.sample(window, own)
    leaves["links"] = network.links(step_keys, neighbours, reach).to(torch.float32)
    if not network.dense(arena.n_uavs):
        leaves["neighbours"] = (neighbours * reach).to(torch.float32)
    scored = alive if motion.valid is None else alive & motion.valid
    sensed = Sensed(motion.position, motion.velocity, motion.attitude, alive, scored, leaves)
    return sensed, carry, whole.map(lambda x, _: x[:, -lead:], whole)


def draw_prior(
    prior: Prior, keys: Int64[Tensor, "B"], truth: Kinematics, scenario: Scenario
) -> Float32[Tensor, "B N F"]:
    """What each UAV is told of its own start: mean position, velocity, attitude, and their
    standard deviations (position per axis, velocity, attitude)."""
    arena = scenario.arena
    n, dim = truth.position.shape[1:]
    turns = 3 if dim == 3 else 1
    draws = noise.normal(keys, "prior", n * (2 * dim + turns)).unflatten(-1, (n, -1)).double()
    low, high = (truth.position.new_tensor(x) for x in (arena.low, arena.high))
    if prior.kind == "uniform":
        position = (0.5 * (low + high)).expand_as(truth.position)
        position_std = ((high - low) / 12**0.5).expand_as(truth.position)
    else:
        position = truth.position + prior.position_std * draws[..., :dim]
        position_std = torch.full_like(position, prior.position_std)
    velocity = truth.velocity + prior.velocity_std * draws[..., dim : 2 * dim]
    attitude = rotate_by(truth.attitude, prior.attitude_std * draws[..., 2 * dim :])
    rest = position.new_tensor((prior.velocity_std, prior.attitude_std)).expand(*position.shape[:2], 2)
    return torch.cat((position, velocity, attitude, position_std, rest), -1).to(torch.float32)
