"""Sensing a window: truth, network and every sensor, for some rows over some steps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import torch
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.channel import Channel
from coloc_env.geometry import level, rotate_by
from coloc_env.motion import Carry, Kinematics
from coloc_env.observation import action_width
from coloc_env.scenario import Prior, Scenario
from coloc_env.sensors.base import Window, in_slots


class _Rows:
    """Base of dataclasses of tensors (or dicts of them) whose first dimension counts worlds."""

    def map(self, f: Callable[..., Tensor], *others: Self) -> Self:
        """``f`` applied to every tensor, and to the same one of the ``others``."""
        every = [[getattr(x, field.name) for x in (self, *others)] for field in fields(self)]  # type: ignore[arg-type]
        return type(self)(*(_apply(f, *values) for values in every))

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """Blocks of worlds as one."""
        return parts[0].map(lambda *tensors: torch.cat(tensors), *parts[1:])


def _apply(f: Callable[..., Tensor], first: Any, *others: Any) -> Any:
    if first is None:
        return None
    if isinstance(first, dict):
        return {name: f(value, *(other[name] for other in others)) for name, value in first.items()}
    return f(first, *others)


@dataclass(frozen=True)
class Past(_Rows):
    """Kinematics [R, H, N, …] of the last steps before a window: for increments and delays."""

    position: Float64[Tensor, "R H N d"]
    velocity: Float64[Tensor, "R H N d"]
    attitude: Float64[Tensor, "R H N a"]


class Frame(NamedTuple):
    """What the world itself needs of one step.

    ``target`` is the position that estimates are scored against, ``over`` is true from the horizon
    on, ``failed`` in the very step in which a UAV fails. A message for slot s comes from UAV
    ``senders[…, s]`` (None: from UAV s); ``bits`` are those of its numbers that arrive: all or
    none.
    """

    target: Float32[Tensor, "R N d"]
    over: Bool[Tensor, "R"]
    failed: Bool[Tensor, "R N"]
    scored: Bool[Tensor, "R N"]
    bits: Int32[Tensor, "R N S*A"]
    senders: Int64[Tensor, "R N S"] | None


@dataclass(frozen=True)
class Sensed(_Rows):
    """A window: truth (float64), what a ``Frame`` has, and leaves (float32), [R, K, N, …] each."""

    position: Float64[Tensor, "R K N d"]
    velocity: Float64[Tensor, "R K N d"]
    attitude: Float64[Tensor, "R K N a"]
    target: Float32[Tensor, "R K N d"]
    steps: Int64[Tensor, "R K"]
    over: Bool[Tensor, "R K"]
    alive: Bool[Tensor, "R K N"]
    failed: Bool[Tensor, "R K N"]
    scored: Bool[Tensor, "R K N"]
    bits: Int32[Tensor, "R K N S*A"]
    senders: Int64[Tensor, "R K N S"] | None
    leaves: dict[str, Float32[Tensor, "R K N F"]]

    @property
    def count(self) -> int:
        """Steps in the window."""
        return self.steps.shape[1]

    @cached_property
    def frames(self) -> list[Frame]:
        """The window's steps one by one (views, cut in one go: far cheaper than one at a time)."""
        parts = [getattr(self, name) for name in Frame._fields]
        cut = ([None] * self.count if part is None else part.unbind(1) for part in parts)
        return [Frame(*views) for views in zip(*cut, strict=True)]

    @cached_property
    def states(self) -> Float32[Tensor, "R K S"]:
        """The truth, flat: per UAV position, velocity, attitude, alive, scored."""
        flags = torch.stack((self.alive, self.scored), -1)
        parts = (self.position, self.velocity, self.attitude, flags)
        return torch.cat([p.to(torch.float32) for p in parts], -1).flatten(2)

    @cached_property
    def all_scored(self) -> bool:
        """Whether every estimate of the window counts."""
        return bool(self.scored.all())

    def __getstate__(self) -> dict[str, Any]:
        """The tensors alone: views are cut again after a copy."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def sense(
    scenario: Scenario,
    keys: Int64[Tensor, "R"],
    first: Int64[Tensor, "R"],
    count: int,
    carry: Carry,
    placed: Sequence[dict[str, Tensor]],
    fails_at: Int64[Tensor, "R N"],
    past: Past | None,
    calls: Int64[Tensor, "R N"] | None = None,
) -> tuple[Sensed, Carry, Past]:
    """Truth and measurements of R rows over ``count`` steps from each row's ``first`` on.

    ``past`` is None at step 0, where the steps before are taken to be like the first. ``calls`` are
    the exchanges that were chosen for these steps (None: links are not chosen).
    """
    arena, network = scenario.arena, scenario.network
    steps = first.unsqueeze(-1) + torch.arange(count, device=keys.device)
    moved, carry = scenario.motion.advance(carry, steps, arena)
    delays = {sensor.delay for sensor in scenario.sensors} - {0}
    lead = max({1} | delays)
    now = Past(moved.position, moved.velocity, moved.attitude)
    if past is None:
        past = now.map(lambda x: x[:, :1].expand(-1, lead, *x.shape[2:]))
    whole = past.map(_join, now)

    def back(by: int) -> Kinematics:
        part = whole.map(lambda x: x[:, lead - by : lead - by + count])
        return Kinematics(part.position, part.velocity, part.attitude)

    motion, before = back(0), back(1)
    if moved.carried is not None:  # nothing that measures motion sees how it was carried
        still = moved.carried.unsqueeze(-1)
        before = Kinematics(
            torch.where(still, motion.position, before.position),
            torch.where(still, motion.velocity, before.velocity),
            before.attitude,
        )
    step_keys = noise.fold(keys.unsqueeze(-1), steps)
    fails_at = fails_at.unsqueeze(1)
    alive = steps.unsqueeze(-1) < fails_at
    neighbours, reach = network.neighbours(motion.position, alive)
    reach = network.unbroken(step_keys, neighbours, reach, motion.position)
    index = torch.arange(arena.n_uavs, device=keys.device)
    for apart in (index >= arena.n_uavs - scenario.targets, index < scenario.strangers):
        if scenario.targets or scenario.strangers:
            reach = reach & ~(apart.unsqueeze(-1) & apart[neighbours])
    to_anchors = None
    if calls is not None:
        near = network.interference or network.radius or float("inf")
        channel = Channel(calls, motion.position[:, -1], near)
        if network.links == "chosen":
            reach, to_anchors = reach & channel.chosen().unsqueeze(1), channel.to_anchors
        else:
            reach = channel.broadcast(reach[:, -1]).unsqueeze(1)
    window = Window(
        layout=scenario.layout,
        rows=keys,
        motion=motion,
        before=before,
        keys=step_keys,
        steps=steps,
        alive=alive,
        neighbours=neighbours,
        reach=reach,
        past={
            by: (back(by), noise.fold(keys.unsqueeze(-1), (steps - by).clamp_min(0)))
            for by in delays
        },
        to_anchors=to_anchors,
        targets=scenario.targets,
    )
    seen = window if moved.valid is None else _where_known(window, moved.valid)
    leaves: dict[str, Tensor] = {}
    for sensor, own in zip(scenario.sensors, placed, strict=True):
        leaves |= sensor.sample(seen if sensor.may_be_blind else window, own)
    delivered = network.delivered(step_keys, neighbours, reach)
    leaves["links"] = delivered.to(torch.float32)
    arrived = delivered & (steps > network.delay)[..., None, None]  # before, none was sent
    leaves["message_mask"] = arrived.to(torch.float32)
    dense = network.dense(arena.n_uavs)
    scored = alive if moved.valid is None else alive & moved.valid
    if scenario.anchor_uavs:
        scored = scored & (torch.arange(arena.n_uavs, device=keys.device) >= scenario.anchor_uavs)
    if not dense:
        leaves["neighbours"] = (neighbours * reach).to(torch.float32)
    sensed = Sensed(
        position=motion.position,
        velocity=motion.velocity,
        attitude=motion.attitude,
        target=motion.position.to(torch.float32),
        steps=steps,
        over=steps >= scenario.horizon,
        alive=alive,
        failed=steps.unsqueeze(-1) == fails_at,
        scored=scored,
        bits=_repeated(arrived.to(torch.int32).neg_(), action_width(scenario)),
        senders=None if dense else neighbours,
        leaves=leaves,
    )
    return sensed, carry, whole.map(lambda x: x[:, -lead:])


def _where_known(window: Window, valid: Bool[Tensor, "R K N"]) -> Window:
    """The window for sensors that are simulated on a recording: where its truth has a hole they
    would measure what was never there, so there they measure nothing."""
    other = in_slots(valid, window.neighbours)
    return replace(
        window, alive=window.alive & valid, reach=window.reach & valid.unsqueeze(-1) & other
    )


def _repeated(x: Int32[Tensor, "R K N S"], times: int) -> Int32[Tensor, "R K N S*A"]:
    """Each number so many times in a row."""
    return x.unsqueeze(-1).expand(*x.shape, times).flatten(-2)


def _join(before: Tensor, now: Tensor) -> Tensor:
    """Steps one after the other, each component contiguous in memory: what sensors compute with."""
    return torch.cat((before.movedim(-1, 0), now.movedim(-1, 0)), 2).movedim(0, -1)


def draw_prior(
    prior: Prior, keys: Int64[Tensor, "B"], truth: Kinematics, scenario: Scenario
) -> Float32[Tensor, "B N F"]:
    """What each UAV knows of its own start: mean position, velocity, attitude, and their
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
        position_std = torch.full_like(truth.position, prior.position_std)
        if scenario.targets and prior.target_std is not None:
            position_std[:, n - scenario.targets :] = prior.target_std
        position = truth.position + position_std * draws[..., :dim]
    velocity = truth.velocity + prior.velocity_std * draws[..., dim : 2 * dim]
    if prior.max_speed is not None:
        velocity = torch.zeros_like(velocity)
    attitude = rotate_by(truth.attitude, prior.attitude_std * draws[..., 2 * dim :])
    if prior.yaw == "uniform":
        attitude = level(attitude)
    rest = position.new_tensor((prior.velocity_spread, prior.attitude_std)).expand(
        *position.shape[:2], 2
    )
    return torch.cat((position, velocity, attitude, position_std, rest), -1).to(torch.float32)
