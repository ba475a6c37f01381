"""The batched world: truth, sensors, network and reward for B independent copies of a scenario.

Every number is a pure function of (row seed, step), so row b of a batch equals the B = 1 world of
the same seed exactly, however many rows share the batch and however many steps are sensed at once.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.motion import Kinematics
from coloc_env.observation import (
    Observation,
    action_width,
    static_leaves,
)
from coloc_env.rewards import reward
from coloc_env.scenario import Scenario
from coloc_env.sense import Past, Sensed, draw_prior, sense

_AGENT_STEPS = 6144  # (row, step, UAV) items sensed at once: what stays in cache


@dataclass(frozen=True)
class Step:
    """What one step of the world brings.

    ``error`` is the position error in m of the estimates just scored, 0 where ``scored`` is False
    (a failed UAV, or a recording without truth at that moment).
    """

    reward: Float32[Tensor, "B N"]
    error: Float32[Tensor, "B N"]
    scored: Bool[Tensor, "B N"]
    terminated: Bool[Tensor, "B N"]
    truncated: Bool[Tensor, "B"]


class World:
    """B worlds of one scenario in lock-step.

    ``window``: how many steps are sensed ahead (default: as many as stay in cache); it changes no
    number. Nothing handed out is ever written to again.
    """

    def __init__(
        self,
        scenario: Scenario,
        batch_size: int = 1,
        device: str | torch.device = "cpu",
        window: int | None = None,
    ) -> None:
        if batch_size < 1:
            raise ValueError(f"World: batch_size={batch_size} is not allowed: at least 1")
        self.scenario = scenario
        self.batch_size = batch_size
        self.device = torch.device(device)
        ahead = _AGENT_STEPS // (batch_size * scenario.arena.n_uavs)
        self.window = window or max(1, min(ahead, 128))
        self._rows = max(1, _AGENT_STEPS // (self.window * scenario.arena.n_uavs))
        if self.device.type != "cpu":
            self._rows = batch_size
        self._delay = scenario.network.delay
        self._static_names = tuple(static_leaves(scenario))
        self.cursor = -1
        self._can_fail = bool(scenario.failure_rate or scenario.failures)
        self._none_failed = torch.zeros(
            batch_size, scenario.arena.n_uavs, dtype=torch.bool, device=self.device
        )
        self._sent: deque[Tensor] = deque(maxlen=self._delay + 1)

    # ---------------------------------------------------------------- reset

    def reset(
        self, seeds: Int64[Tensor, "B"] | Sequence[int] | int, rows: Bool[Tensor, "B"] | None = None
    ) -> Observation:
        """Start the rows marked in ``rows`` (default: all) anew and return the observation.

        ``seeds``: one per row, or one integer s for rows seeded s, s+1, …; those of other rows are
        ignored.
        """
        b = self.batch_size
        if isinstance(seeds, int):
            seeds = torch.arange(seeds, seeds + b)
        seeds = torch.as_tensor(seeds, dtype=torch.int64, device=self.device)
        if seeds.shape != (b,):
            raise ValueError(f"World: {b} seeds are needed, one a row, got {tuple(seeds.shape)}")
        if rows is None or self.cursor < 0 or bool(rows.all()):
            self.seeds = seeds
            self.step_index = torch.zeros(b, dtype=torch.int64, device=self.device)
            self._sent.clear()
            self.cursor = 0
            self._place(seeds)
            self._sense(self.window, None)
        else:
            self._reset_rows(seeds, rows.nonzero()[:, 0])
        self._since_reset = 0
        return self.observation()

    def _place(self, seeds: Int64[Tensor, "B"]) -> None:
        """All that is drawn once an episode."""
        scenario, keys = self.scenario, noise.row_keys(seeds)
        self._keys = keys
        self._carry = scenario.motion.start(keys, scenario.arena)
        self._placed = [sensor.place(keys, scenario.layout) for sensor in scenario.sensors]
        self._fails_at = self._failures(keys)
        n = scenario.arena.n_uavs
        self._static: dict[str, Tensor] = {}
        for sensor, placed in zip(scenario.sensors, self._placed, strict=True):
            for name, value in sensor.map_values(placed).items():
                self._static[name] = value.unsqueeze(1).expand(-1, n, -1).contiguous()

    def _failures(self, keys: Int64[Tensor, "R"]) -> Int64[Tensor, "R N"]:
        """The step at which each UAV fails; beyond the horizon if it does not."""
        scenario = self.scenario
        n, horizon = scenario.arena.n_uavs, scenario.horizon
        never = torch.full((len(keys), n), horizon + 1, device=keys.device)
        if scenario.failure_rate:
            fails, when = noise.uniform(keys, "failure", 2 * n).unflatten(-1, (2, n)).unbind(1)
            at = 1 + (when * (horizon - 1)).to(torch.int64)
            never = torch.where(fails < scenario.failure_rate, at, never)
        for uav, step in scenario.failures:
            never[:, uav] = step
        return never

    def _reset_rows(self, seeds: Int64[Tensor, "B"], rows: Int64[Tensor, "r"]) -> None:
        """Reset some rows in the middle of a window, into fresh memory."""
        fresh = World(self.scenario, len(rows), self.device, self.window - self.cursor)
        fresh.reset(seeds[rows])

        def merge(old: Tensor, new: Tensor, start: int | None = None) -> Tensor:
            old = old.clone()
            if start is None:
                old[rows] = new
            else:
                old[rows, start:] = new
            return old

        self.seeds = merge(self.seeds, fresh.seeds)
        self.step_index = merge(self.step_index, fresh.step_index)
        self._keys = merge(self._keys, fresh._keys)
        self._fails_at = merge(self._fails_at, fresh._fails_at)
        self._carry = {k: merge(v, fresh._carry[k]) for k, v in self._carry.items()}
        self._static = {k: merge(v, fresh._static[k]) for k, v in self._static.items()}
        self._placed = [
            {k: merge(v, new[k]) for k, v in old.items()}
            for old, new in zip(self._placed, fresh._placed, strict=True)
        ]
        self._past = self._past.map(merge, fresh._past)
        self.sensed = self.sensed.map(lambda old, new: merge(old, new, self.cursor), fresh.sensed)

    # ---------------------------------------------------------------- sense

    def _sense(self, count: int, past: Past | None) -> None:
        """Sense ``count`` steps from the rows' current ones on, in blocks that stay in cache."""
        blocks = []
        for start in range(0, self.batch_size, self._rows):
            part = slice(start, start + self._rows)
            blocks.append(
                sense(
                    self.scenario,
                    keys=self._keys[part],
                    first=self.step_index[part],
                    count=count,
                    carry={k: v[part] for k, v in self._carry.items()},
                    placed=[{k: v[part] for k, v in p.items()} for p in self._placed],
                    fails_at=self._fails_at[part],
                    past=past.map(lambda x, _: x[part], past) if past else None,
                )
            )
        if len(blocks) == 1:
            self.sensed, self._carry, self._past = blocks[0]
        else:
            sensed, carries, pasts = zip(*blocks, strict=True)
            self.sensed = Sensed.cat(sensed)
            self._carry = {k: torch.cat([c[k] for c in carries]) for k in carries[0]}
            self._past = Past.cat(pasts)
        if past is None:
            truth = self.truth
            self._static["prior"] = draw_prior(self.scenario.prior, self._keys, truth, self.scenario)

    # ---------------------------------------------------------------- step

    def step(self, estimates: Float32[Tensor, "B N A"]) -> Step:
        """Score ``estimates`` of the current step (position m, velocity m/s, log-std, world frame),
        then move every row one step on; rows past their horizon are to be reset by the caller.
        The next step's measurements are ``observation()``.
        """
        error, scored = self.score(estimates)
        position = self.sensed.position[:, self.cursor]
        value = reward(self.scenario.reward, estimates, position, error, scored)
        alive = self.alive
        self.advance(estimates)
        return Step(
            reward=value,
            error=error,
            scored=scored,
            terminated=alive & ~self.alive if self._can_fail else self._none_failed,
            truncated=self.step_index >= self.scenario.horizon,
        )

    def score(
        self, estimates: Float32[Tensor, "B N A"]
    ) -> tuple[Float32[Tensor, "B N"], Bool[Tensor, "B N"]]:
        """Position error in m at the current step, and where it counts."""
        dim = self.scenario.arena.dim
        difference = estimates[..., :dim] - self.sensed.position[:, self.cursor]
        scored = self.sensed.scored[:, self.cursor]
        error = torch.linalg.vector_norm(difference, dim=-1).to(torch.float32) * scored
        return error, scored

    def advance(self, estimates: Float32[Tensor, "B N A"]) -> None:
        """Send the estimates as messages and move to the next step."""
        self._sent.append(estimates)
        self.step_index = self.step_index + 1
        self.cursor += 1
        self._since_reset += 1
        if self.cursor == self.sensed.count:
            self.cursor = 0
            self._sense(self.window, self._past)

    # ---------------------------------------------------------------- views

    @property
    def truth(self) -> Kinematics:
        """True kinematics [B, N, …] at the current step (float64); privileged."""
        s, i = self.sensed, self.cursor
        return Kinematics(s.position[:, i], s.velocity[:, i], s.attitude[:, i])

    @property
    def alive(self) -> Bool[Tensor, "B N"]:
        """UAVs that have not failed."""
        return self.sensed.alive[:, self.cursor]

    @property
    def static(self) -> dict[str, Float32[Tensor, "B N F"]]:
        """Leaves that stay the same over an episode."""
        return {name: self._static[name] for name in self._static_names}

    def state(self) -> Float32[Tensor, "B S"]:
        """The privileged truth, flat: per UAV position, velocity, attitude, alive, scored."""
        s, i = self.sensed, self.cursor
        flags = torch.stack((s.alive[:, i], s.scored[:, i]), -1)
        parts = (s.position[:, i], s.velocity[:, i], s.attitude[:, i], flags)
        return torch.cat([p.to(torch.float32) for p in parts], -1).flatten(1)

    def messages(self) -> tuple[Float32[Tensor, "B N F"], Float32[Tensor, "B N S"]]:
        """Delivered messages and their mask: what senders' actions said 1 + delay steps ago."""
        links = self.sensed.leaves["links"][:, self.cursor]
        width = action_width(self.scenario)
        if len(self._sent) <= self._delay:
            b, n, s = links.shape
            return links.new_zeros(b, n, s * width), torch.zeros_like(links)
        sent, mask = self._sent[0], links
        if self._since_reset <= self._delay:
            mask = links * (self.step_index > self._delay)[:, None, None]
        neighbours = self.sensed.neighbours(self.cursor)
        if neighbours is None:
            content = sent.unsqueeze(1)
        else:
            content = sent[torch.arange(len(sent), device=sent.device)[:, None, None], neighbours]
        return (content * mask.unsqueeze(-1)).flatten(-2), mask

    def observation(self) -> Observation:
        """What every UAV observes at the current step."""
        leaves = {name: leaf[:, self.cursor] for name, leaf in self.sensed.leaves.items()}
        leaves["messages"], leaves["message_mask"] = self.messages()
        return Observation(leaves | self.static)

    def check(self, estimates: Tensor) -> None:
        """Raise a ValueError for estimates of a wrong shape or with values that are not finite."""
        shape = (self.batch_size, self.scenario.arena.n_uavs, action_width(self.scenario))
        if tuple(estimates.shape) != shape:
            raise ValueError(
                f"{self.scenario.name}: actions of shape {tuple(estimates.shape)} do not fit: "
                f"{shape} (worlds, UAVs, [position, velocity, log-std]) is needed"
            )
        finite = estimates.isfinite()
        if not bool(finite.all()):
            row, uav, _ = (~finite).nonzero()[0].tolist()
            raise ValueError(
                f"{self.scenario.name}: the action of uav_{uav} in world {row} holds NaN or "
                "infinity; every number must be finite"
            )
