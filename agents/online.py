"""A localizer fed by measurements as they come: ``OnlineLocalizer``."""

import time
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from agents.localizer import Estimate, finite_action
from agents.registry import make
from coloc_env.datasets.grid import Grid
from coloc_env.datasets.live import LiveSamples, Sample, setup_recording
from coloc_env.datasets.noise_model import corrected
from coloc_env.datasets.open_format.description import FILE, read_description
from coloc_env.datasets.recording import DataError, Recording
from coloc_env.datasets.replay import arena_of
from coloc_env.datasets.starts import level
from coloc_env.network import Network
from coloc_env.observation import Observation, prior_action
from coloc_env.scenario import Believed, PriorOptions
from coloc_env.scenarios.replay import own_beliefs, own_prior, own_team
from coloc_env.sensors import LandmarkBearings, Sensor, UavBearings
from coloc_env.sensors.base import Layout

_JUMP = 60.0  # s: a stamp farther from the newest one is of another clock,
_AGREE = 20  # and where so many in a row are, the team's clock was set
_LEVEL = 1_000_000_000  # ns of an IMU that show which way is up
_TIMED = 100_000  # steps of which the duration is remembered


@dataclass(frozen=True)
class Located:
    """Where the team is at a step: ``stamp`` in ns on the setup's clock, and each robot's estimate,
    world frame (ENU), m and m/s. ``attitude`` [N, a]: quaternion wxyz or heading in rad, None where
    the method estimates none."""

    stamp: int
    position: Float[np.ndarray, "N d"]
    velocity: Float[np.ndarray, "N d"]
    covariance: Float[np.ndarray, "N d d"]
    attitude: Float[np.ndarray, "N a"] | None


@dataclass(frozen=True)
class _Past:
    """What there was after step ``k``: belief, what was sent, the estimate (none before the
    first)."""

    k: int
    belief: Any = None
    action: Float32[Tensor, "B N A"] | None = None
    located: Located | None = None


class OnlineLocalizer:
    """A localizer of a whole team, fed by measurements as they come.

    Steps are ``dt`` s apart, from ``start`` on (a stamp as in events; none: from when every robot
    has a sample of what drives the motion model). A step uses what came in since the one before,
    as in ``replay-v0``, and is run when an event of more than ``wait`` s later has come. A
    measurement that comes later than its step, but at most ``horizon`` s, has the steps since run
    again from the belief before it.

    Args:
        agent: a localizer's name, options included (``ekf_trust``, ``ekf:robust=huber``).
        setup: a ``recording.yaml`` with ``streams``, or its folder; no data are read.
        believed: a ``believed.yaml`` (none: what the setup says under ``believed``).
        process: the motion model, as in ``replay-v0``.
        depth: sightings of one landmark or robot that one step takes; more are left out.
        prior_std: standard deviation (m) of the setup's ``start``; where none is given, robots
            start anywhere in a box around the map.
        prior: the leaf ``prior`` [N, F], in place of those two.

    Raises:
        ValueError: the setup or an option does not fit; one line that says what is allowed.
    """

    def __init__(
        self,
        agent: str,
        setup: str | Path,
        *,
        believed: str | None = None,
        process: str = "auto",
        dt: float = 0.1,
        start: float | int | str | None = None,
        horizon: float = 1.0,
        wait: float = 0.0,
        depth: int = 4,
        prior_std: float = 0.5,
        prior: Float32[Tensor, "N F"] | None = None,
    ) -> None:
        for name, value, least in (("dt", dt, 0.001), ("horizon", horizon, 0), ("wait", wait, 0)):
            if not least <= value <= _JUMP:
                raise ValueError(f"{name}={value} is not allowed: s from {least} to {_JUMP:g}")
        if depth < 1:
            raise ValueError(f"depth={depth} is not allowed: at least 1")
        path = Path(setup)
        path = path / FILE if path.is_dir() else path
        about = read_description(path)
        whole = setup_recording(about)
        model = own_beliefs(whole, path, believed)
        known = corrected(whole, model)
        self._team = own_team(known, model, process)
        used = [s for s in known.streams if s in self._team.sensors or s == self._team.driver]
        self.samples = LiveSamples(about, whole, model, used, self._team.driver)
        self.robots, self.agent = about.robots, agent
        self.dt, self._period = dt, round(dt * 1e9)
        self._horizon, self._wait = round(horizon * 1e9), round(wait * 1e9)
        self._asked = None if start is None else int(self.samples.time(start, "start")[0])
        self._start: int | None = None
        self._prior_std, self._depth = prior_std, depth
        self._constants(known, prior)
        self.localizer = make(agent, self._believed)
        self._past = deque([_Past(-1)], maxlen=2 + self._horizon // self._period)
        self._newest: int | None = None
        self._redo: int | None = None  # the first step that is to be run again
        self._ahead: list[tuple[str, list[Sample]]] = []
        self._heard: dict[str, int] = {}
        self.counts: Counter[str] = Counter()
        self.seconds: deque[float] = deque(maxlen=_TIMED)

    # ---------------------------------------------------------------- events

    def add(self, robot: str, sensor: str, stamp: Any, **values: Any) -> None:
        """Take a measurement: the row of a robot's table ``sensor`` in the open format.

        Raises:
            DataError: it is malformed; one line that says how, and what is allowed.
        """
        self.take(self.samples.read(robot, sensor, stamp, values), robot)

    def take(self, samples: list[Sample], robot: str) -> None:
        """Take samples that were read already, of one event."""
        if not samples:
            self.counts["unused"] += 1
            return
        newest = max(time for _, _, time, _ in samples)
        if self._newest is not None and abs(newest - self._newest) > _JUMP * 1e9:
            self.counts["of another clock"] += 1
            self._ahead.append((robot, samples))
            if len(self._ahead) < _AGREE:
                return
            self._set_clock()
        else:
            self._ahead.clear()
            self._keep(samples, robot)

    def _keep(self, samples: list[Sample], robot: str) -> None:
        self.counts["events"] += 1
        reached = self._time(self._past[-1].k) if self._start is not None else None
        for sample in samples:
            stamp = sample[2]
            late = reached is not None and stamp <= reached
            if late and stamp <= self._time(self._past[0].k):
                self.counts["too late"] += 1
            elif not self.samples.insert(sample):
                self.counts["doubled"] += 1
            elif late:
                self.counts["late"] += 1
                assert self._start is not None
                step = -(-(stamp - self._start) // self._period)
                self._redo = step if self._redo is None else min(step, self._redo)
            self._newest = max(stamp, self._newest or stamp)
            self._heard[robot] = max(stamp, self._heard.get(robot, stamp))

    def _set_clock(self) -> None:
        """The team's clock was set: go on with the belief from the first stamps of the new one."""
        events, self._ahead = self._ahead, []
        self.counts["clock set"] += 1
        last = self._past[-1]
        self.samples.clear()
        first = min(time for _, samples in events for _, _, time, _ in samples)
        self._newest, self._redo, self._heard = None, None, {}
        if self._start is not None:
            self._start = first - 1 - last.k * self._period
            self._past = deque([last], maxlen=self._past.maxlen)
        for robot, samples in events:
            self._keep(samples, robot)

    def silent(self, seconds: float = 2.0) -> list[str]:
        """Robots from which nothing came for so long."""
        if self._newest is None:
            return list(self.robots)
        last = self._newest - round(seconds * 1e9)
        return [name for name in self.robots if self._heard.get(name, last - 1) < last]

    # ---------------------------------------------------------------- steps

    def steps(self) -> Iterator[Located]:
        """Run the steps that are due, and give what each comes to."""
        if self._newest is not None:
            yield from self._run(self._newest - self._wait - 1)

    def estimate(self, stamp: Any) -> Located | None:
        """The team at the last step that is not after ``stamp``, with all that came in for it; None
        before the first step, and for a step that is no longer remembered.

        Raises:
            DataError: the stamp is no time, or more than a minute after everything that came in.
        """
        until = int(self.samples.time(stamp, "estimate")[0])
        if self._newest is None or until > self._newest + _JUMP * 1e9:
            raise DataError(f"estimate: stamp {stamp!r} is more than {_JUMP:g} s after all events")
        for _ in self._run(until):
            pass
        known = [past.located for past in self._past if past.located is not None]
        return next((one for one in reversed(known) if one.stamp <= until), None)

    def _run(self, until: int) -> Iterator[Located]:
        """Run all steps up to a time that were not run yet, or are to be run again."""
        if not self._started(until):
            return
        if self._redo is not None:
            reached = self._past[-1].k
            while self._past[-1].k >= self._redo:
                self._past.pop()
            self._redo = None
            while self._past[-1].k < reached:
                self._step()
                self.counts["run again"] += 1
        while self._time(self._past[-1].k + 1) <= until:
            yield self._step()

    def _started(self, until: int) -> bool:
        """Whether it is known where the steps lie."""
        first = self.samples.first()
        if first is None:
            return False
        if self._start is not None:
            return True
        start = first if self._asked is None else self._asked
        start += max(0, -(-(first - start) // self._period)) * self._period
        if self._team.driver == "imu" and until < start + _LEVEL and self._prior is None:
            return False  # which way is up is not known yet
        if self._prior is None:
            self._prior = self._drawn_from_setup(Grid(start, self.dt, 2))
        self._start = start
        return True

    def _step(self) -> Located:
        began = time.perf_counter()
        before = self._past[-1]
        k = before.k + 1
        observation = self._observation(k, before.action)
        with torch.no_grad():
            belief = self.localizer.reset(observation) if before.belief is None else before.belief
            belief, estimate = self.localizer.step(belief, observation)
        last = before.action
        if last is None:
            last = prior_action(observation, self._believed.arena.dim)
        action, finite = finite_action(estimate, last)
        if not bool(finite.all()):
            self.counts["not finite"] += 1
        located = self._located(k, belief, estimate)
        self._past.append(_Past(k, belief, action, located))
        self.samples.forget(self._time(self._past[0].k))
        self.counts["steps"] += 1
        self.seconds.append(time.perf_counter() - began)
        return located

    def _time(self, k: int) -> int:
        assert self._start is not None
        return self._start + k * self._period

    def _located(self, k: int, belief: Any, estimate: Estimate) -> Located:
        d = self._believed.arena.dim
        try:
            state = self.localizer.mean(belief)
            attitude = state[0, :, 2 * d : 2 * d + (1 if d == 2 else 4)].numpy()
        except ValueError:
            attitude = None
        position, velocity, covariance = (
            each[0].double().numpy()
            for each in (estimate.position, estimate.velocity, estimate.covariance)
        )
        position = position + self.samples.shift
        return Located(self._time(k), position, velocity, covariance, attitude)

    # ---------------------------------------------------------------- observation

    def _constants(self, known: Recording, prior: Float32[Tensor, "N F"] | None) -> None:
        """All that stays the same: what the team believes, maps, links, who hears whom."""
        n, grid = len(self.robots), Grid(0, self.dt, 2)
        network = Network()
        if not network.dense(n):
            raise DataError(f"{n} robots are more than the {network.max_neighbours} that fit")
        pairs = [each(known, grid) for each in self._team.sensors.values()]
        if self._team.driver:
            pairs.append(self._team.drive(known, grid, None))
        sensors = [_deeper(belief, self._depth) for _, belief in pairs]
        arena = arena_of(known, grid, margin=1.0)
        layout = Layout(arena, network.slots(n))
        self._believed = Believed(
            arena=arena,
            slots=layout.slots,
            process=self._team.process,
            sensors=(*sensors, *self._team.assumed),
            prior=own_prior(known, PriorOptions(prior_std=self._prior_std)),
        )
        self._widths = {
            name: leaf.width for each in sensors for name, leaf in each.leaves(layout).items()
        }
        self._maps = {
            name: value.expand(1, n, -1) for found, _ in pairs for name, value in found.maps.items()
        }
        self._links = (1.0 - torch.eye(n)).unsqueeze(0)
        self._unheard = torch.eye(n, dtype=torch.bool).repeat_interleave(3 * arena.dim, -1)
        self._prior = None if prior is None else prior.to(torch.float32).unsqueeze(0)

    def _observation(self, k: int, sent: Float32[Tensor, "B N A"] | None) -> Observation:
        """What ``replay-v0`` delivers at step k."""
        assert self._prior is not None
        until = self._time(k)
        grid = Grid(until - self._period, self.dt, 2)
        now = self.samples.window(grid.start, until)
        found = [each(now, grid)[0] for each in self._team.sensors.values()]
        if self._team.driver:
            found.append(self._team.drive(now, grid, self.samples.like())[0])
        leaves = {}
        for sensor in found:
            for name, series in sensor.series.items():
                leaf, width = series.values[1], self._widths.get(name, series.values.shape[-1])
                if leaf.shape[-1] != width:
                    leaf = torch.nn.functional.pad(leaf, (0, width - leaf.shape[-1]))
                leaves[name] = leaf.unsqueeze(0)
        leaves["links"] = self._links
        width = self._unheard.shape[-1]
        if sent is None:
            leaves["messages"] = torch.zeros(1, len(self.robots), width)
            leaves["message_mask"] = torch.zeros_like(self._links)
        else:
            content = sent.view(1, 1, -1).expand(1, len(self.robots), width)
            leaves["messages"] = content.masked_fill(self._unheard, 0.0)
            leaves["message_mask"] = self._links
        return Observation({**leaves, "prior": self._prior, **self._maps})

    def _drawn_from_setup(self, grid: Grid) -> Float32[Tensor, "B N F"]:
        """The prior: about the setup's start, level as the IMU shows; else anywhere."""
        arena, prior, n = self._believed.arena, self._believed.prior, len(self.robots)
        d = arena.dim
        first = self.samples.window(grid.start - 1, grid.start + _LEVEL)
        recording = level(first, grid) if self._team.driver == "imu" else first
        start = recording.start
        if not len(start):
            start = np.full((n, 3 if d == 2 else 7), np.nan)
        nothing = np.array((0.0,) if d == 2 else (1.0, 0.0, 0.0, 0.0))
        place = np.where(np.isnan(start[:, :d]), arena.centre, start[:, :d])
        turn = np.where(np.isnan(start[:, d:]), nothing, start[:, d:])
        spread = np.full(d, prior.position_std)
        if prior.kind == "uniform":
            place, spread = np.tile(arena.centre, (n, 1)), np.subtract(arena.high, arena.low)
            spread = spread / 12**0.5
        rest = np.array((prior.velocity_spread, prior.attitude_std))
        stds = np.tile(np.concatenate((spread, rest)), (n, 1))
        whole = np.concatenate((place, np.zeros((n, d)), turn, stds), 1)
        return torch.from_numpy(whole).to(torch.float32).unsqueeze(0)


def _deeper(belief: Sensor, depth: int) -> Sensor:
    """A belief about bearings with room for so many of one thing in a step."""
    if isinstance(belief, LandmarkBearings | UavBearings):
        return replace(belief, depth=depth)
    return belief
