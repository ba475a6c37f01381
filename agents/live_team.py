"""What a team that is moving now believes and observes: ``replay-v0``'s, without a recording."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor
from torch.nn.functional import pad

from coloc_env.datasets.corrections import corrected
from coloc_env.datasets.grid import Grid
from coloc_env.datasets.live import LiveSamples, setup_recording
from coloc_env.datasets.open_format.description import FILE, read_description
from coloc_env.datasets.recording import DataError, Recording
from coloc_env.datasets.replay import arena_of
from coloc_env.datasets.starts import level
from coloc_env.network import Network
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, PriorOptions
from coloc_env.scenarios.replay import own_beliefs, own_prior, own_team
from coloc_env.sensors import ArrivalAngles, LandmarkBearings, Sensor, Tdoa, UavBearings
from coloc_env.sensors.base import Layout

LEVEL = 1_000_000_000  # ns of an IMU that show which way is up


class LiveTeam:
    """The team of a setup: its ``samples``, what it has ``believed`` in, its observations.

    Arguments as ``OnlineLocalizer`` has them. Raises ValueError where they do not fit.
    """

    def __init__(
        self,
        setup: str | Path,
        believed: str | None,
        process: str,
        dt: float,
        depth: int,
        prior_std: float,
        prior: Float32[Tensor, "N F"] | None,
    ) -> None:
        path = Path(setup)
        path = path / FILE if path.is_dir() else path
        about = read_description(path)
        whole = setup_recording(about)
        model = own_beliefs(whole, path, believed)
        known = corrected(whole, model)
        self._team = own_team(known, model, process)
        self.driver = self._team.driver
        used = [s for s in known.streams if s in self._team.sensors or s == self.driver]
        self.samples = LiveSamples(about, whole, model, used, self.driver)
        self.robots, self.dt = about.robots, dt
        self._period = round(dt * 1e9)
        self._prior = None if prior is None else prior.to(torch.float32).unsqueeze(0)
        self._constants(known, depth, prior_std)

    def start_at(self, start: int, until: int) -> bool:
        """Make up the prior at the first step (ns); False while, of what came until now, it cannot
        be given which way is up."""
        if self._prior is None:
            if self.driver == "imu" and until < start + LEVEL:
                return False
            counted = self.samples.surplus  # of windows that are no step's
            self._prior = self._prior_at(Grid(start, self.dt, 2))
            self.samples.surplus = counted
        return True

    def observation(self, until: int, sent: Float32[Tensor, "B N A"] | None) -> Observation:
        """What ``replay-v0`` delivers at the step at a time (ns); ``sent``: actions of the step
        before, none at the first."""
        assert self._prior is not None
        grid = Grid(until - self._period, self.dt, 2)
        now = self.samples.window(grid.start, until)
        found = [each(now, grid)[0] for each in self._team.sensors.values()]
        if self.driver:
            found.append(self._team.drive(now, grid, self.samples.like())[0])
        leaves = {}
        for sensor in found:
            for name, series in sensor.series.items():
                leaf = series.values[1]
                room = self._widths.get(name, leaf.shape[-1]) - leaf.shape[-1]
                leaves[name] = (pad(leaf, (0, room)) if room else leaf).unsqueeze(0)
        leaves["links"] = self._links
        shape = self._unheard.shape
        if sent is None:
            leaves["messages"] = torch.zeros(1, *shape)
            leaves["message_mask"] = torch.zeros_like(self._links)
        else:
            content = sent.view(1, 1, -1).expand(1, *shape)
            leaves["messages"] = content.masked_fill(self._unheard, 0.0)
            leaves["message_mask"] = self._links
        return Observation({**leaves, "prior": self._prior, **self._maps})

    @property
    def prior(self) -> Float32[Tensor, "B N F"] | None:
        """The leaf of that name; None before the first step, unless it was given."""
        return self._prior

    @prior.setter
    def prior(self, prior: Float32[Tensor, "B N F"]) -> None:
        self._prior = prior

    # ---------------------------------------------------------------- parts

    def _constants(self, known: Recording, depth: int, prior_std: float) -> None:
        """All that stays the same: what the team believes, maps, links, who hears whom."""
        n, grid = len(self.robots), Grid(0, self.dt, 2)
        network = Network()
        if not network.dense(n):
            raise DataError(f"{n} robots are more than the {network.max_neighbours} that fit")
        pairs = [each(known, grid) for each in self._team.sensors.values()]
        if self.driver:
            pairs.append(self._team.drive(known, grid, None))
        sensors = [_deeper(belief, depth) for _, belief in pairs]
        arena = arena_of(known, grid, margin=1.0)
        layout = Layout(arena, network.slots(n))
        self.believed = Believed(
            arena=arena,
            slots=layout.slots,
            process=self._team.process,
            sensors=(*sensors, *self._team.assumed),
            prior=own_prior(known, PriorOptions(prior_std=prior_std)),
        )
        self._widths = {
            name: leaf.width for each in sensors for name, leaf in each.leaves(layout).items()
        }
        self._maps = {
            name: value.expand(1, n, -1) for found, _ in pairs for name, value in found.maps.items()
        }
        self._links = (1.0 - torch.eye(n)).unsqueeze(0)
        own: Bool[Tensor, "N N"] = torch.eye(n, dtype=torch.bool)
        self._unheard = own.repeat_interleave(3 * arena.dim, -1)

    def _prior_at(self, grid: Grid) -> Float32[Tensor, "B N F"]:
        """The prior: about the setup's start, level as the IMU shows; else anywhere in the box."""
        arena, prior, n = self.believed.arena, self.believed.prior, len(self.robots)
        d = arena.dim
        recording = self.samples.window(grid.start - 1, grid.start + LEVEL)
        start = (level(recording, grid) if self.driver == "imu" else recording).start
        if not len(start):
            start = np.full((n, 3 if d == 2 else 7), np.nan)
        nothing = np.array((0.0,) if d == 2 else (1.0, 0.0, 0.0, 0.0))
        place = np.where(np.isnan(start[:, :d]), arena.centre, start[:, :d])
        turn = np.where(np.isnan(start[:, d:]), nothing, start[:, d:])
        spread: Any = np.full(d, prior.position_std)
        if prior.kind == "uniform":
            place = np.tile(arena.centre, (n, 1))
            spread = np.subtract(arena.high, arena.low) / 12**0.5
        stds = np.concatenate((spread, (prior.velocity_spread, prior.attitude_std)))
        whole = np.concatenate((place, np.zeros((n, d)), turn, np.tile(stds, (n, 1))), 1)
        return torch.from_numpy(whole).to(torch.float32).unsqueeze(0)


def _deeper(belief: Sensor, depth: int) -> Sensor:
    """A belief about what may come several times in a step, with room for so many of one thing."""
    if isinstance(belief, ArrivalAngles | LandmarkBearings | Tdoa | UavBearings):
        return replace(belief, depth=depth)
    return belief
