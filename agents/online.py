"""A localizer fed by measurements as they come: ``OnlineLocalizer``."""

import copy
import time
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from agents.live_team import LiveTeam
from agents.localizer import Estimate, finite_action
from agents.registry import make
from coloc_env import state_file
from coloc_env.datasets.live import Sample
from coloc_env.datasets.recording import DataError
from coloc_env.observation import prior_action

_JUMP = 60.0  # s: a stamp farther from the newest one is of another clock,
_AGREE = 20  # and where so many in a row are, the team's clock was set
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
        self._team = LiveTeam(setup, believed, process, dt, depth, prior_std, prior)
        self.samples, self.robots, self.agent = self._team.samples, self._team.robots, agent
        self._period = round(dt * 1e9)
        self._horizon, self._wait = round(horizon * 1e9), round(wait * 1e9)
        self._asked = None if start is None else int(self.samples.time(start, "start")[0])
        self._start: int | None = None
        self.localizer = make(agent, self._team.believed)
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

    def steps(self, *, whole: bool = False) -> Iterator[Located]:
        """Run the steps that are due, and give what each comes to; ``whole``: nothing more is
        waited for."""
        if self._newest is not None:
            yield from self._run(self._newest - (0 if whole else self._wait + 1))

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
        if not self._team.start_at(start, until):
            return False
        self._start = start
        return True

    def _step(self) -> Located:
        began = time.perf_counter()
        before = self._past[-1]
        k = before.k + 1
        observation = self._team.observation(self._time(k), before.action)
        belief = before.belief
        try:
            with torch.no_grad():
                belief = self.localizer.reset(observation) if belief is None else belief
                belief, estimate = self.localizer.step(belief, observation)
        except (ArithmeticError, RuntimeError, np.linalg.LinAlgError) as error:
            raise ValueError(f"{self.agent} broke down at step {k}: {error}") from error
        last = before.action
        if last is None:
            last = prior_action(observation, self._team.believed.arena.dim)
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
        turned = self.localizer.attitude(belief)
        attitude = None if turned is None else turned[0].numpy()
        position, velocity, covariance = (
            each[0].double().numpy()
            for each in (estimate.position, estimate.velocity, estimate.covariance)
        )
        position = position + self.samples.shift
        return Located(self._time(k), position, velocity, covariance, attitude)

    # ---------------------------------------------------------------- restarts

    def save(self, path: str | Path) -> None:
        """Write the belief and the samples that are still needed, with a checksum.

        Raises:
            ValueError: before the first step, and for a localizer whose belief is not of tensors.
        """
        last = self._past[-1]
        if last.belief is None or last.action is None or self._start is None:
            raise ValueError("there is no belief to save before the first step")
        flat = last.belief.to_tensordict().flatten_keys("/")
        if not all(isinstance(value, Tensor) for value in flat.values()):
            raise ValueError(f"{self.agent}: its belief cannot be saved")
        state = {
            "of": self._signature,
            "start": self._start,
            "k": last.k,
            "belief": dict(flat.items()),
            "action": last.action,
            "prior": self._team.prior,
            "samples": self.samples.state(),
        }
        state_file.save(Path(path), state)

    def load(self, path: str | Path) -> None:
        """Go on from what ``save`` wrote, whole or, where anything is raised, not at all.

        Raises:
            ValueError: the file is damaged, or of another agent, team, step or sensors.
            OSError: it cannot be read.
        """
        state = state_file.load(Path(path))
        for name, mine in self._signature.items():
            if state.get("of", {}).get(name) != mine:
                raise ValueError(f"{path}: {name} is not {mine!r}: it is of another localizer")
        start, k, team = state["start"], state["k"], copy.deepcopy(self._team)
        newest = team.samples.restore(state["samples"])
        team.prior = state["prior"]
        fresh = self.localizer.reset(team.observation(start + k * self._period, None))
        flat = fresh.to_tensordict().flatten_keys("/")
        if flat.keys() != state["belief"].keys():
            raise ValueError(f"{path}: an older coloc's belief of {self.agent} has other parts")
        flat.update(state["belief"])
        belief = type(fresh).from_tensordict(flat.unflatten_keys("/"))
        self._team, self.samples = team, team.samples
        self._start, self._newest, self._redo = start, newest, None
        self._past = deque([_Past(k, belief, state["action"])], maxlen=self._past.maxlen)

    @property
    def _signature(self) -> dict[str, Any]:
        """What must be the same where a belief is loaded."""
        return {
            "agent": self.agent,
            "robots": list(self.robots),
            "streams": list(self.samples.streams),
            "period": self._period,
        }
