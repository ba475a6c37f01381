"""The run record: all that is kept of runs, as numpy arrays, from here to tables, figures, studies.

R runs, K steps, N UAVs; lengths in m, world frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from agents.localizer import Localizer
from coloc_env.scenario import Scenario
from coloc_env.world import World
from training.evaluation import metrics
from training.evaluation.metrics import Flags, Floats
from training.evaluation.rollout import Breakdown, Step, rollout
from training.evaluation.team import team_figures

Arrays = dict[str, np.ndarray]
Facts = dict[str, Any]
_SERIES = "series."


@dataclass(frozen=True, eq=False)
class Worlds:
    """The worlds that were met, seeded ``seed`` … ``seed`` + R − 1, the same for every agent.

    ``truth`` [R, K, N, d]; ``attitude`` [K, N, a] of the first run (quaternion wxyz, body to world,
    or heading in rad); ``scored`` [R, K, N]: where estimates count. ``links`` [K, N, N] of the
    first run: whether a message of UAV j reaches UAV i; ``places`` of its landmarks and anchors
    [M, d] (None and empty where they were not kept).
    """

    seed: int
    truth: Floats
    attitude: Floats
    scored: Flags
    links: Flags | None = None
    places: dict[str, Floats] = field(default_factory=dict)

    def to_arrays(self) -> Arrays:
        """What tables and figures are made of."""
        return {"truth": self.truth, "attitude": self.attitude, "scored": self.scored}

    @classmethod
    def from_arrays(cls, seed: int, arrays: Mapping[str, np.ndarray]) -> Worlds:
        return cls(seed, arrays["truth"], arrays["attitude"], arrays["scored"])

    @staticmethod
    def cat(parts: Sequence[Worlds]) -> Worlds:
        """Blocks of runs one after the other."""
        if len(parts) == 1:
            return parts[0]
        return Worlds(
            parts[0].seed,
            np.concatenate([part.truth for part in parts]),
            parts[0].attitude,
            np.concatenate([part.scored for part in parts]),
            parts[0].links,
            parts[0].places,
        )


@dataclass(frozen=True, eq=False)
class RunRecord:
    """R runs of one agent.

    ``offset`` p̂ − p [R, K, N, d] and ``error`` its length [R, K, N]; ``nees`` [R, K, N] of the
    position, NaN where the covariance is not positive definite; ``broken`` [R]: runs with NaN,
    infinity or a numerical error; ``messages`` of such errors, one a run that raised one;
    ``series``: the method's own figures [R, K, N], of which the mean is reported, or the sum over a
    run where the name ends in ``_per_run``; ``ms_per_step`` of the whole team, B = 1, one thread;
    ``covariance`` [K, N, d, d] (m²) of the positions in the first run, and ``attitude`` [K, N, a]
    (None where it was not kept, or is not estimated).
    """

    worlds: Worlds
    offset: Floats
    error: Floats
    nees: Floats
    broken: Flags
    messages: tuple[str, ...] = ()
    series: dict[str, Floats] = field(default_factory=dict)
    ms_per_step: float | None = None
    covariance: Floats | None = None
    attitude: Floats | None = None

    def _repr_html_(self) -> str:
        """What there is, in notebooks."""
        runs, steps, uavs = self.error.shape
        scored = self.worlds.scored
        rows = {
            "runs, steps, UAVs": f"{runs}, {steps}, {uavs}",
            "seeds": f"{self.worlds.seed} … {self.worlds.seed + runs - 1}",
            "RMSE": f"{metrics.rmse(self.error, scored):.3g} m",
            "mean NEES": f"{metrics.mean(self.nees[scored]):.3g}",
            "broken runs": f"{int(self.broken.sum())}",
            "series": escape(", ".join(self.series)) or "none",
        }
        cells = "".join(f"<tr><th>{name}</th><td>{text}</td></tr>" for name, text in rows.items())
        return f"<table><caption>RunRecord</caption>{cells}</table>"

    def to_arrays(self) -> tuple[Arrays, Facts]:
        """The agent's own arrays, and facts that JSON can hold; the worlds are not among them."""
        arrays = {name: getattr(self, name) for name in ("offset", "error", "nees", "broken")}
        arrays |= {_SERIES + name: values for name, values in self.series.items()}
        return arrays, {"messages": list(self.messages), "ms_per_step": self.ms_per_step}

    @classmethod
    def from_arrays(
        cls, worlds: Worlds, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]
    ) -> RunRecord:
        """What ``to_arrays`` made; arrays that are not a record's are left out."""
        return cls(
            worlds,
            arrays["offset"],
            arrays["error"],
            arrays["nees"],
            arrays["broken"],
            tuple(facts["messages"]),
            {
                name.removeprefix(_SERIES): values
                for name, values in arrays.items()
                if name.startswith(_SERIES)
            },
            facts["ms_per_step"],
        )

    @staticmethod
    def cat(parts: Sequence[RunRecord], worlds: Worlds | None = None) -> RunRecord:
        """Blocks of runs one after the other, in ``worlds`` (default: the blocks' own)."""
        if len(parts) == 1:
            return parts[0] if worlds is None else replace(parts[0], worlds=worlds)
        blank = np.full((1, *parts[0].error.shape[1:]), np.nan, np.float32)

        def joined(name: str) -> np.ndarray:
            return np.concatenate([getattr(part, name) for part in parts])

        def series(name: str) -> np.ndarray:
            every = [
                part.series.get(name, np.broadcast_to(blank, part.error.shape)) for part in parts
            ]
            return np.concatenate(every)

        return RunRecord(
            Worlds.cat([part.worlds for part in parts]) if worlds is None else worlds,
            joined("offset"),
            joined("error"),
            joined("nees"),
            joined("broken"),
            tuple(message for part in parts for message in part.messages),
            {
                name: series(name)
                for name in dict.fromkeys(n for part in parts for n in part.series)
            },
            parts[0].ms_per_step,
            parts[0].covariance,
            parts[0].attitude,
        )


def record(
    localizer: Localizer,
    scenario: Scenario,
    seeds: Tensor,
    progress: Callable[[int], None] = lambda steps: None,
    device: str | torch.device = "cpu",
) -> RunRecord:
    """The runs of some consecutive seeds, in one batch as long as the localizer raises nothing.

    Where it does, the batch is halved until it is known whose run it is; that run goes on with its
    last estimates. ``progress(run_steps)`` is called as steps are done. On another ``device`` than
    the CPU, where the localizer must be, nothing is copied back before the end.
    """
    try:
        return _recorded(localizer, scenario, seeds, progress, None, device)
    except Breakdown as breakdown:
        progress(-breakdown.k * len(seeds))
        if len(seeds) > 1:
            halves = seeds.tensor_split(2)
            return RunRecord.cat(
                [record(localizer, scenario, half, progress, device) for half in halves]
            )
        found = _recorded(localizer, scenario, seeds, progress, breakdown.k, device)
        return replace(found, broken=np.ones(1, bool), messages=(" ".join(str(breakdown).split()),))


def _recorded(
    localizer: Localizer,
    scenario: Scenario,
    seeds: Tensor,
    progress: Callable[[int], None],
    stop: int | None,
    device: str | torch.device,
) -> RunRecord:
    """A batch of runs; from step ``stop`` on the last estimates stand."""

    def blank(*size: int, dtype: torch.dtype = torch.float32, value: float = 0.0) -> Tensor:
        return torch.full(size, value, dtype=dtype, device=device)

    dim, shape = scenario.arena.dim, (len(seeds), scenario.horizon, scenario.arena.n_uavs)
    truth = blank(*shape, dim, dtype=torch.float64)
    attitude = blank(*shape[1:], 4 if dim == 3 else 1, dtype=torch.float64)
    offset, error = blank(*shape, dim), blank(*shape)
    consistency = blank(*shape, value=torch.nan)
    scored, broken = blank(*shape, dtype=torch.bool), blank(shape[0], dtype=torch.bool)
    covariance = blank(*shape[1:], dim, dim, value=torch.nan)
    turned: list[Tensor] = []
    links = blank(*shape[1:], shape[2], dtype=torch.bool)
    series: dict[str, Tensor] = {}
    for step in rollout(localizer, scenario, seeds, stop=stop, device=device):
        k, world = step.k, step.world
        links[k] = step.world.links(0)
        truth[:, k], attitude[k] = world.truth.position, world.truth.attitude[0]
        apart = step.action[..., :dim] - world.truth.position
        offset[:, k] = apart.to(torch.float32)
        error[:, k], scored[:, k] = world.score(step.action)
        broken |= (~step.finite & world.alive).any(-1)
        if step.estimate is not None:
            covariance[k] = step.estimate.covariance[0]
            now = localizer.attitude(step.belief[:1])
            turned += [] if now is None else [now[0].double()]
            consistency[:, k] = nees(apart, step.estimate.covariance.double()).to(torch.float32)
            for name, value in _own_figures(localizer, step).items():
                if name not in series:
                    series[name] = blank(*shape, value=torch.nan)
                series[name][:, k] = value.to(torch.float32)
        progress(len(seeds))
    return RunRecord(
        Worlds(
            int(seeds[0]),
            truth.cpu().numpy(),
            attitude.cpu().numpy(),
            scored.cpu().numpy(),
            links.cpu().numpy(),
            places_of(step.world),
        ),
        offset.cpu().numpy(),
        error.cpu().numpy(),
        consistency.cpu().numpy(),
        broken.cpu().numpy(),
        series={name: values.cpu().numpy() for name, values in series.items()},
        covariance=covariance.cpu().numpy(),
        attitude=torch.stack(turned).cpu().numpy() if len(turned) == scenario.horizon else None,
    )


def places_of(world: World) -> dict[str, Floats]:
    """Positions [M, d] of landmarks and anchors in the first world, m."""
    dim, static = world.scenario.arena.dim, world.static
    anchors = "anchor_map" if "anchor_map" in static else "tdoa_map"
    maps = {"landmarks": "landmark_map", "anchors": anchors}
    return {
        name: static[leaf][0, 0].reshape(-1, dim).cpu().numpy()
        for name, leaf in maps.items()
        if leaf in static
    }


def _own_figures(localizer: Localizer, step: Step) -> dict[str, Tensor]:
    """A method's own figures at a step, and the errors of what it estimates of the team, if so."""
    poses = localizer.team(step.belief)
    figures = localizer.diagnostics(step.belief)
    return figures if poses is None else figures | team_figures(poses, step.world.truth)


def nees(
    offset: Float64[Tensor, "*s d"], covariance: Float64[Tensor, "*s d d"]
) -> Float64[Tensor, "*s"]:
    """Normalized estimation error squared eᵀ P⁻¹ e; NaN where P is not positive definite."""
    root, wrong = torch.linalg.cholesky_ex(torch.nan_to_num(covariance))
    scaled = torch.linalg.solve_triangular(root, offset.unsqueeze(-1), upper=False)[..., 0]
    squared = (scaled * scaled).sum(-1)
    good = (wrong == 0) & squared.isfinite()
    return torch.where(good, squared, torch.nan)
