"""The batched world: truth, sensors, network and reward for B independent copies of a scenario.

Every number is a pure function of (row seed, step), so row b of a batch equals the B = 1 world of
the same seed exactly, however many rows share the batch and however many steps are sensed at once.
"""

from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.commands import SILENT, Commands
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation, action_width, static_leaves
from coloc_env.rewards import reward
from coloc_env.scenario import Scenario
from coloc_env.seeding import checked_seeds
from coloc_env.sensing import Frame, Past, Sensed, draw_prior, sense

_AGENT_STEPS = 12288  # (row, step, UAV) items sensed at once: more would not be faster
_LONGEST = 512  # steps sensed ahead at most: a reset throws away what was not used
_NEVER = 1 << 62

Leaves = dict[str, Float32[Tensor, "B *K N F"]]


def steps_ahead(scenario: Scenario, batch_size: int, longest: int = _LONGEST) -> int:
    """How many steps it pays to sense at once."""
    at_once = _AGENT_STEPS // max(1, batch_size * scenario.arena.n_uavs)
    return max(1, min(at_once, longest, scenario.horizon + 1))


class Step(NamedTuple):
    """What one step of the world brings.

    ``error`` is the position error in m of the estimates just scored, 0 where ``scored`` is False
    (an anchor UAV, a failed UAV, or a recording without truth at that moment).
    """

    reward: Float32[Tensor, "B N"]
    error: Float32[Tensor, "B N"]
    scored: Bool[Tensor, "B N"]
    terminated: Bool[Tensor, "B N"]
    truncated: Bool[Tensor, "B"]


class World:
    """B worlds of one scenario in lock-step.

    ``window``: how many steps are sensed ahead (default: as many as pay); it changes no number.
    Observations handed out are never written to again, and what is done to them in place changes
    nothing that the world goes on with.
    """

    sensed: Sensed
    _past: Past

    def __init__(
        self,
        scenario: Scenario,
        batch_size: int = 1,
        device: str | torch.device = "cpu",
        window: int | None = None,
    ) -> None:
        for name, value in (("batch_size", batch_size), ("window", window)):
            if value is not None and value < 1:
                raise ValueError(f"World: {name}={value} is not allowed: at least 1")
        self.scenario = scenario
        self.batch_size = batch_size
        self.device = torch.device(device)
        self.window = window or steps_ahead(scenario, batch_size)
        if scenario.commanded:
            self.window = 1
        self._rows = max(1, _AGENT_STEPS // (self.window * scenario.arena.n_uavs))
        if self.device.type != "cpu":
            self._rows = batch_size
        self._delay = scenario.network.delay
        self._dim, self._width = scenario.arena.dim, action_width(scenario)
        self._static_names = tuple(static_leaves(scenario))
        self.cursor = -1
        self._zero = torch.zeros((), dtype=torch.float32, device=self.device)
        self._observed: Sensed | None = None
        self._sent: deque[Tensor] = deque(maxlen=self._delay + 1)

    # ---------------------------------------------------------------- reset

    def reset(
        self, seeds: Int64[Tensor, "B"] | Sequence[int] | int, rows: Bool[Tensor, "B"] | None = None
    ) -> Observation:
        """Restart the rows marked in ``rows`` (default: all) and return the observation.

        ``seeds``: one per row, or one integer s for rows seeded s, s+1, …; those of other rows are
        ignored. Raises ValueError for another number of seeds, and for one that is not a whole
        number from 0 to 2⁶².
        """
        self.restart(seeds, rows)
        return self.observation()

    def restart(
        self, seeds: Int64[Tensor, "B"] | Sequence[int] | int, rows: Bool[Tensor, "B"] | None = None
    ) -> None:
        """``reset`` without the observation: for a face, which builds its own."""
        seeds = checked_seeds(seeds, self.batch_size, self.device)
        if rows is None or self.cursor < 0 or bool(rows.all()):
            self.seeds = seeds.clone()
            self._sent.clear()
            self._place(seeds)
            self._sense(torch.zeros_like(seeds), None)
        else:
            self._reset_rows(seeds, rows.nonzero()[:, 0])

    def _place(self, seeds: Int64[Tensor, "B"]) -> None:
        """All that is drawn once an episode."""
        scenario, keys = self.scenario, noise.row_keys(seeds)
        self._keys = keys
        self._carry = scenario.motion.start(keys, scenario.arena)
        self._placed = [sensor.place(keys, scenario.layout) for sensor in scenario.sensors]
        self._fails_at = self._failures(keys)
        n = scenario.arena.n_uavs
        self._called = torch.zeros(len(keys), n, dtype=torch.int64, device=keys.device)
        self._calls = torch.full_like(self._called, SILENT)
        self._static: dict[str, Tensor] = {}
        for sensor, placed in zip(scenario.sensors, self._placed, strict=True):
            for name, value in sensor.map_values(placed).items():
                self._static[name] = value.unsqueeze(1).repeat(1, n, 1)

    def _failures(self, keys: Int64[Tensor, "R"]) -> Int64[Tensor, "R N"]:
        """The step at which each UAV fails; one that is never reached if it does not."""
        scenario = self.scenario
        n, horizon = scenario.arena.n_uavs, scenario.horizon
        fails_at = torch.full((len(keys), n), _NEVER, device=keys.device)
        if scenario.failure_rate:
            fails, when = noise.uniform(keys, "failure", 2 * n).unflatten(-1, (2, n)).unbind(1)
            at = 1 + (when * (horizon - 1)).to(torch.int64)
            fails_at = torch.where(fails < scenario.failure_rate, at, fails_at)
        for uav, step in scenario.failures:
            fails_at[:, uav] = step
        return fails_at

    def _reset_rows(self, seeds: Int64[Tensor, "B"], rows: Int64[Tensor, "r"]) -> None:
        """Reset some rows in the middle of a window, into fresh memory."""
        if not len(rows):
            return
        left = self.sensed.map(lambda x: x[:, self.cursor :])
        fresh = World(self.scenario, len(rows), self.device, left.count)
        fresh.restart(seeds[rows])

        def merge(old: Tensor, new: Tensor) -> Tensor:
            return old.index_put((rows,), new)

        self.seeds = merge(self.seeds, fresh.seeds)
        self._keys = merge(self._keys, fresh._keys)
        self._fails_at = merge(self._fails_at, fresh._fails_at)
        self._calls = merge(self._calls, fresh._calls)
        self._called = merge(self._called, fresh._called)
        self._carry = {k: merge(v, fresh._carry[k]) for k, v in self._carry.items()}
        self._static = {k: merge(v, fresh._static[k]) for k, v in self._static.items()}
        self._placed = [
            {k: merge(v, new[k]) for k, v in old.items()}
            for old, new in zip(self._placed, fresh._placed, strict=True)
        ]
        self._past = self._past.map(merge, fresh._past)
        self.sensed, self.cursor = left.map(merge, fresh.sensed), 0

    # ---------------------------------------------------------------- sense

    def _sense(self, first: Int64[Tensor, "B"], past: Past | None) -> None:
        """Sense a window from each row's ``first`` step on, in blocks of rows."""
        blocks = []
        for start in range(0, self.batch_size, self._rows):
            part = slice(start, start + self._rows)
            blocks.append(
                sense(
                    self.scenario,
                    keys=self._keys[part],
                    first=first[part],
                    count=self.window,
                    carry={k: v[part] for k, v in self._carry.items()},
                    placed=[{k: v[part] for k, v in p.items()} for p in self._placed],
                    fails_at=self._fails_at[part],
                    past=past.map(lambda x, part=part: x[part]) if past else None,
                    calls=None if self.scenario.network.links == "all" else self._calls[part],
                )
            )
        sensed, carries, pasts = zip(*blocks, strict=True)
        if len(blocks) == 1:
            self.sensed, self._carry, self._past = blocks[0]
        else:
            self.sensed, self._past = Sensed.cat(sensed), Past.cat(pasts)
            self._carry = {k: torch.cat([c[k] for c in carries]) for k in carries[0]}
        self.cursor = 0
        if past is None:
            prior = draw_prior(self.scenario.prior, self._keys, self.truth, self.scenario)
            self._static["prior"] = prior

    # ---------------------------------------------------------------- step

    def step(self, estimates: Float32[Tensor, "B N A"], commands: Commands | None = None) -> Step:
        """Score ``estimates`` of the current step (position m, velocity m/s, log-std, world frame),
        then move every row one step on, as it is commanded where it takes commands; rows past their
        horizon are to be reset by the caller. The next step's measurements are ``observation()``.
        """
        error, scored = self.score(estimates)
        value = reward(self.scenario.reward, estimates, self.now.target, error, scored)
        self.advance(estimates, commands)
        now = self.now
        return Step(value, error, scored, terminated=now.failed, truncated=now.over)

    def score(
        self, estimates: Float32[Tensor, "B N A"]
    ) -> tuple[Float32[Tensor, "B N"], Bool[Tensor, "B N"]]:
        """Position error in m at the current step, and where it counts.

        Estimates are float32, and so is the truth they are scored against: the true position as an
        action has an error of exactly 0.
        """
        now = self.now
        error = torch.linalg.vector_norm(estimates.narrow(-1, 0, self._dim) - now.target, dim=-1)
        if not self.sensed.all_scored:  # chosen, not multiplied: nobody's NaN counts as 0
            error = torch.where(now.scored, error, self._zero)
        return error, now.scored

    def advance(
        self, estimates: Float32[Tensor, "B N A"], commands: Commands | None = None
    ) -> None:
        """Send (copies of) the estimates as messages and move to the next step."""
        self._command(commands or Commands())
        sent = estimates.clone(memory_format=torch.contiguous_format)
        self._sent.append(sent.view(torch.int32).view(self.batch_size, 1, -1))
        self.cursor += 1
        if self.cursor == self.sensed.count:
            self._sense(self.sensed.steps[:, -1] + 1, self._past)

    def _command(self, commands: Commands) -> None:
        """Take the commands of the step to come, and count the calls in it."""
        scenario = self.scenario
        motion, calls = commands
        if motion is not None:
            if not scenario.motion.steered:
                raise ValueError(f"{scenario.name}: its motion is not steered: no command fits")
            if motion.shape != self._carry["command"].shape or not bool(motion.isfinite().all()):
                shape = tuple(self._carry["command"].shape)
                raise ValueError(
                    f"{scenario.name}: commands of shape {tuple(motion.shape)} do not fit: finite "
                    f"numbers of shape {shape} (worlds, UAVs, axes) are needed"
                )
            self._carry = {**self._carry, "command": motion.to(torch.float64, copy=True)}
        if scenario.network.links == "all":
            return
        calls = torch.full_like(self._calls, SILENT) if calls is None else calls
        if calls.shape != self._calls.shape or calls.dtype != torch.int64:
            raise ValueError(
                f"{scenario.name}: calls of {calls.dtype} and shape {tuple(calls.shape)} do not "
                f"fit: int64 of shape {tuple(self._calls.shape)} (worlds, UAVs) are needed"
            )
        self._calls = torch.where(self.alive, calls, SILENT)
        self._called = self._called + (self._calls >= 0)

    # ---------------------------------------------------------------- views

    @property
    def messages_sent(self) -> Int64[Tensor, "B N"]:
        """Messages that each UAV has sent since its reset: one a step until it fails, or as many as
        it called where links are chosen or broadcast."""
        if self.scenario.network.links == "all":
            return torch.minimum(self.step_index.unsqueeze(-1), self._fails_at)
        return self._called

    @property
    def bytes_sent(self) -> Int64[Tensor, "B N"]:
        """Bytes of these messages: float32 numbers of an estimate each."""
        return 4 * self._width * self.messages_sent

    @property
    def now(self) -> Frame:
        """What is scored, who counts and who hears whom at the current step."""
        return self.sensed.frames[self.cursor]

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
    def step_index(self) -> Int64[Tensor, "B"]:
        """The step each row is at: 0 after its reset."""
        return self.sensed.steps[:, self.cursor]

    @property
    def static(self) -> dict[str, Float32[Tensor, "B N F"]]:
        """Leaves that stay the same over an episode."""
        return {name: self._static[name] for name in self._static_names}

    @property
    def obstacles(self) -> Float64[Tensor, "B C d"]:
        """Where what moves in the way of signals is (m) at the current step; privileged."""
        sight, arena = self.scenario.sight, self.scenario.arena
        if not sight.obstacles:
            return self.truth.position[:, :0]
        return sight.places(self._keys, self.step_index.unsqueeze(-1), arena)[:, 0]

    def state(self) -> Float32[Tensor, "B S"]:
        """The privileged truth, flat: per UAV position, velocity, attitude, alive, scored."""
        return self.sensed.states[:, self.cursor].clone()

    def links(self, row: int) -> Bool[Tensor, "N N"]:
        """Whether a message that UAV j sends now would reach UAV i, in one world."""
        heard, senders = self.sensed.leaves["links"][row, self.cursor] > 0, self.now.senders
        if senders is None:
            return heard
        counts = torch.zeros(len(heard), len(heard), dtype=torch.int64, device=self.device)
        return counts.scatter_add_(1, senders[row], heard.long()) > 0

    def messages(self) -> Float32[Tensor, "B N F"]:
        """Delivered messages: senders' actions of 1 + delay steps ago, 0 where there is none."""
        now = self.now
        if len(self._sent) <= self._delay:
            return torch.zeros_like(now.bits, dtype=torch.float32)
        sent = self._sent[0]
        if now.senders is not None:
            rows = torch.arange(self.batch_size, device=self.device)[:, None, None]
            sent = sent.unflatten(-1, (-1, self._width))[rows, 0, now.senders].flatten(-2)
        # Chosen, not multiplied: a diverged sender's NaN reaches only those who hear it.
        return (sent & now.bits).view(torch.float32)

    def observation(self) -> Observation:
        """What every UAV observes at the current step."""
        if self._observed is not self.sensed:
            self._observed = self.sensed
            self._frames = self._leaf_frames()
        return Observation({**self._frames[self.cursor], "messages": self.messages()})

    def __getstate__(self) -> dict[str, Any]:
        """All but the copies: each view would bring its whole window along."""
        state = {k: v for k, v in self.__dict__.items() if k != "_frames"}
        return {**state, "_observed": None}

    def _leaf_frames(self) -> list[Leaves]:
        """Leaves of each step in the window, messages aside.

        Copies, so that edits in place by those who observe reach no other step, and cut in one go:
        far cheaper than one step at a time.
        """
        count = self.sensed.count
        leaves = {name: leaf.clone() for name, leaf in self.sensed.leaves.items()}
        leaves |= {k: v.unsqueeze(1).repeat(1, count, 1, 1) for k, v in self.static.items()}
        parts = (leaf.unbind(1) for leaf in leaves.values())
        return [dict(zip(leaves, views, strict=True)) for views in zip(*parts, strict=True)]
