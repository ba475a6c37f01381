"""What localizers are tested on: runs of small scenarios, recorded once for all tests."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

from agents import LOCALIZERS, Estimate, Localizer, make
from agents.models.measurements import Block, Measurement, Neighbours
from agents.models.process import Process
from coloc_env import scenario as settings
from coloc_env.motion import Aggressive, Arena, RandomVelocity
from coloc_env.network import Network
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, ConstantVelocity, Inertial, Prior, Scenario, Wheeled
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import (
    AnchorRanging,
    Height,
    Imu,
    LandmarkBearings,
    Odometry,
    Ranging,
    Sensor,
    UavBearings,
)
from coloc_env.world import World, steps_ahead

SEEDS, STEPS, PARTICLES = (3, 4), 4, 33
TAGS = (((0.2, 0.1, -0.1), (-0.3, 0.0, 0.1)),) * 3
CORNERS = ((0.0, 0.0, 0.0), (10.0, 8.0, 4.0), (0.0, 8.0, 1.0), (10.0, 0.0, 3.0))


def custom(dim: int, n: int, process: settings.Process, sensors: tuple[Sensor, ...]) -> Scenario:
    """A scenario that no family has, in a box of 10 × 8 × 4 m."""
    return Scenario(
        name="custom",
        arena=Arena(dim, n, 0.1, (0.0,) * dim, (10.0, 8.0, 4.0)[:dim]),
        horizon=400,
        motion=Aggressive() if dim == 3 else RandomVelocity(),
        sensors=sensors,
        network=Network(),
        prior=Prior(position_std=0.5, velocity_std=0.1),
        process=process,
        believed_sensors=sensors,
    )


def plane() -> Scenario:
    bearings = LandmarkBearings(count=6, radius=20.0, share=0.8, depth=2)
    return custom(2, 4, Wheeled(), (Odometry(), bearings, UavBearings(share=0.7)))


def tags() -> Scenario:
    anchors, ranging = AnchorRanging(CORNERS, tags=TAGS), Ranging(tags=TAGS)
    return custom(3, 3, Inertial(), (Imu(), anchors, ranging, Height()))


def indoor(**overrides: Any) -> Callable[[], Scenario]:
    return lambda: make_scenario("indoor-v0", **overrides)


FAMILIES: dict[str, Callable[[], Scenario]] = {
    "default": indoor(),
    "nlos": indoor(nlos=0.3),
    "few": indoor(landmarks=4),
    "late": indoor(landmarks=4, message_delay=1),
    "biased": indoor(landmarks=4, anchors=2, range_bias_std=0.2),
    "uniform": indoor(prior="uniform"),
    "imu_bias": indoor(imu_bias=True),
    "anchors": indoor(imu=False, landmarks=0, anchors=8),
    "slots": indoor(n_uavs=20),
    "ranges": indoor(landmarks=0, nlos=0.3),
    "many": indoor(landmarks=0, n_uavs=20),
    "sight": indoor(uwb=False),
    "sight_few": indoor(uwb=False, landmarks=4),
    "sight_uniform": indoor(uwb=False, prior="uniform"),
    "sight_bias": indoor(uwb=False, imu_bias=True, n_uavs=20),
    "unnamed": indoor(association="unknown"),
    "any_yaw": indoor(prior_yaw="uniform"),
    "unmapped": indoor(landmarks=6, landmarks_known=False, anchors=4, n_uavs=3),
    "plane": plane,
    "tags": tags,
    "wsn": lambda: make_scenario("wsn-v0", n_uavs=3, uwb_dropout=0.2),
    "swarm": lambda: make_scenario("swarm-v0", n_uavs=8, anchor_share=0.4, nlos_time=3.0),
    "campus": lambda: make_scenario("campus-v0", flight="s3", dt=0.5),
    "stein2d": lambda: make_scenario("stein2d-v0", matches_per_step=2),
    "stein3d": lambda: make_scenario("stein3d-v0", n_uavs=4),
    "stein_imu": lambda: make_scenario("stein3d-v0", n_uavs=4, imu=True, motion="random"),
}
ALL = "huber+gate+ransac+temporal+cross"
VARIANTS = (
    "ekf:robust=huber",
    "ekf:robust=huber+gate",
    "ekf:robust=ransac",
    "ekf:robust=temporal",
    "ekf:robust=cross",
    "ekf:robust=student",
    "ekf:robust=mixture",
    "pf500:likelihood=student",
    f"ekf:robust={ALL}:fusion=ci",
    f"ekf_joint:robust={ALL}",
    "ekf:fusion=ci",
    "ekf:fusion=pairwise",
    f"ekf:robust={ALL}:fusion=pairwise",
    "ekf:fusion=exchange",
    "ekf_joint:robust=huber",
    "pf500:perturb=fixed:tempering=false",
    "apf:variant=paper",
    "pfnn:variant=paper",
    "dfgo:exchange=all",
)
REFUSED = {("ekf_joint", "slots")}
# Families where a localizer's own code meets something new. Those that only extend another (pfnn
# the apf, a trust filter its Kalman or particle filter, pf, pf800, ippo and sb3-ppo their twins)
# need no family again that the other runs in, and twins none but one.
CHOSEN = {
    "dead_reckoning": ("default", "imu_bias", "anchors", "plane", "campus"),  # a motion model each
    "ekf_joint": ("default", "few", "uniform", "imu_bias", "anchors", "plane", "tags", "swarm"),
    "ekf_trust": ("default", "plane", "tags"),
    "pf500": ("default", "anchors", "plane"),
    **dict.fromkeys(("pfnn", "pf_trust"), ("default", "plane")),
    "pf_auxiliary": ("default", "anchors"),
    "pf_corrected": ("default", "anchors", "plane", "tags"),
    "pf_mixture": ("default", "uniform", "plane"),
    "pf_rao_blackwell": ("default", "imu_bias", "anchors", "plane", "tags"),
    "mappo": ("default", "slots", "plane"),
    **dict.fromkeys(("pf", "pf800", "ippo", "sb3-ppo"), ("default",)),
    "dfgo": (
        "default",
        "uniform",
        "imu_bias",
        "anchors",
        "slots",
        "plane",
        "tags",
        "unmapped",
        "unnamed",
    ),
    "dfgo_central": ("default", "imu_bias", "plane", "unmapped", "unnamed"),
    "dlspf": ("default", "uniform", "imu_bias", "anchors", "slots", "tags"),
    "ukf": ("default", "uniform", "imu_bias", "anchors", "slots", "plane", "tags", "unnamed"),
    "mhekf": ("default", "uniform", "imu_bias", "anchors", "slots", "plane", "unnamed", "any_yaw"),
    "emvf": ("few", "anchors", "plane", "tags", "wsn"),
    "hpff": ("anchors", "wsn"),
    "nnhpff": ("anchors", "tags"),
    "dwmds_st": ("ranges", "anchors", "many", "swarm", "campus", "tags"),
    "map": ("ranges", "anchors", "swarm"),
    "mds": ("ranges", "many", "tags"),  # among few, one that fails moves the map by a metre
    "dwmds": ("ranges", "anchors", "many", "tags"),
    "vmds": ("ranges", "anchors"),
    **dict.fromkeys(("fcmds", "gn"), ("anchors", "many", "tags")),
    "stdcl": ("anchors", "swarm", "campus"),
    "stgat": ("swarm",),
    **dict.fromkeys(("cspf", "pose_graph"), ("stein2d", "stein3d", "stein_imu")),
    "pf_joint": ("stein2d", "stein3d"),
    **dict.fromkeys(("slam", "slam_central"), ("unmapped",)),
    "stein_vi": ("sight", "sight_few", "sight_uniform", "sight_bias"),
}
SPECIAL = ("wsn", "swarm", "campus", "stein2d", "stein3d", "stein_imu", "ranges", "many")
SPECIAL = (
    *SPECIAL,
    "unmapped",
    "unnamed",
    "any_yaw",
    "late",
    "biased",
    "sight",
    "sight_few",
    "sight_uniform",
    "sight_bias",
)
ELSEWHERE = [f for f in FAMILIES if f not in SPECIAL]
CASES = [
    *((n, f) for n in LOCALIZERS for f in CHOSEN.get(n, ELSEWHERE)),
    *((n, "default") for n in VARIANTS),
    *((n, "plane") for n in VARIANTS if ALL in n or "fusion" in n or "perturb" in n),
    *((f"ekf:fusion={f}", "tags") for f in ("ci", "pairwise", "exchange")),
    *((f"ekf:fusion={f}", "late") for f in ("ci", "pairwise", "exchange")),
    *((n, "wsn") for n in ("pf", "ekf")),
    *((n, "unnamed") for n in ("ekf", "ekf:association=nearest", "apf", "ekf:robust=temporal")),
    *((n, "any_yaw") for n in ("ekf", "apf", "ukf")),
    *((n, "unnamed") for n in ("pf500", "pf500:association=joint", "pf_trust", "ekf_trust")),
    *((n, "biased") for n in ("ekf", "ekf_joint", "ekf:fusion=pairwise")),
    *((n, "swarm") for n in ("ekf", "pf", "ekf:robust=huber")),
    *((f"cspf:{o}", "stein2d") for o in ("broadcast=true", "variant=neighbourhood")),
    *(("stdcl:variant=calibrated", f) for f in ("swarm", "campus")),
    ("slam:maps=own", "unmapped"),
    *((n, "slots") for n in ("ekf:robust=temporal", "ekf:robust=cross")),
]
CASES = [case for case in CASES if case not in REFUSED]
# For what depends on a localizer, or on a family, but not on the pair: every localizer once, and
# every family with one Kalman, one particle and one swarm filter.
THROUGHOUT = ("ekf", "apf", "dwmds_st")
SAMPLE = [*{name: (name, family) for name, family in reversed(CASES)}.values()]
SAMPLE += [case for case in CASES if case[0] in THROUGHOUT and case not in SAMPLE]


@dataclass(frozen=True)
class Run:
    """Beliefs before each step and after the last, and what each step was given and said."""

    observations: Sequence[Observation]
    beliefs: Sequence[Any]
    estimates: Sequence[Estimate]

    @property
    def position(self) -> Tensor:
        """[K, B, N, d]"""
        return torch.stack([e.position for e in self.estimates])


@dataclass(frozen=True)
class Case:
    """A localizer and its run of ``STEPS`` steps in worlds ``SEEDS`` of a scenario."""

    name: str
    family: str
    scenario: Scenario
    localizer: Localizer
    run: Run


def build(name: str, scenario: Scenario) -> Localizer:
    """The localizer, with few particles if it has any."""
    known = LOCALIZERS.options_of(name.split(":")[0])
    few: dict[str, Any] = {"particles": PARTICLES} if "particles" in known else {}
    if "bounds" in known and known["bounds"].default is not None:
        few["bounds"] = (PARTICLES - 10, PARTICLES + 20)
    if name.startswith("dfgo"):
        few["window"] = 3
    if "every" in known:
        few["every"] = 2
    if "weights" in known and not name.startswith("dlspf"):  # untrained, it decodes nothing
        few["weights"] = "none"
    if "main" in known:
        few["main"] = f"pf@particles={PARTICLES}@tempering=true"
    return make(name, scenario, **few)


def room(name: str, **overrides: Any) -> Scenario:
    """``indoor-v0`` with what a localizer serves: among anchors alone, or without UWB;
    ``stein2d-v0`` and ``swarm-v0`` for those that serve nothing else."""
    chosen = CHOSEN.get(name, ("default",))
    if "stein2d" in chosen:
        return make_scenario("stein2d-v0", **overrides)
    if name in ("stdcl", "stgat"):
        return make_scenario("swarm-v0", **{"n_uavs": 6, **overrides})
    if "unmapped" in chosen:
        few = {"landmarks_known": False, "landmarks": 6, "anchors": 4}
        return make_scenario("indoor-v0", **few, **overrides)
    if "sight" in chosen:
        return make_scenario("indoor-v0", uwb=False, **overrides)
    among: dict[str, Any] = {} if "default" in chosen else {"anchors": 8, "landmarks": 0}
    return make_scenario("indoor-v0", **among, **overrides)


def play(localizer: Localizer, scenario: Scenario, seeds: Iterable[int], steps: int) -> Run:
    """A run in which the UAVs send their estimates as messages. No step is sensed that is not
    needed."""
    seeds = torch.tensor(list(seeds))
    window = steps_ahead(scenario, len(seeds), steps + 1)
    world = World(scenario, len(seeds), window=window)
    observation = world.reset(seeds)
    run = Run([], [localizer.reset(observation)], [])
    for _ in range(steps):
        belief, estimate = localizer.step(run.beliefs[-1], observation)
        run.observations.append(observation)
        run.beliefs.append(belief)
        run.estimates.append(estimate)
        world.advance(estimate.action())
        observation = world.observation()
    return run


def replay(localizer: Localizer, observations: Sequence[Observation]) -> Run:
    """A run on observations that do not answer to it."""
    run = Run(observations, [localizer.reset(observations[0])], [])
    for observation in observations:
        belief, estimate = localizer.step(run.beliefs[-1], observation)
        run.beliefs.append(belief)
        run.estimates.append(estimate)
    return run


def score(name: str, scenario: Scenario, runs: int, steps: int) -> SimpleNamespace:
    """Errors [R, K, N, d] in m and NEES [R, K, N] of the position, in worlds 0, 1, …"""
    localizer, world = make(name, scenario), World(scenario, runs)
    observation, errors, nees = world.reset(0), [], []
    belief = localizer.reset(observation)
    for _ in range(steps):
        belief, estimate = localizer.step(belief, observation)
        error = estimate.position.double() - world.truth.position
        solved = torch.linalg.solve(estimate.covariance.double(), error)
        errors.append(error)
        nees.append((error * solved).sum(-1))
        world.advance(estimate.action())
        observation = world.observation()
    error = torch.stack(errors, 1)
    squared = error.square().sum(-1)
    return SimpleNamespace(
        rmse=float(squared.mean().sqrt()),
        rmse_per_run=squared.mean((1, 2)).sqrt(),
        nees=torch.stack(nees, 1),
    )


def consistent(nees: Tensor, dim: int) -> float:
    """Share of the steps at which the mean NEES [R, K, N] lies in its 95 % interval."""
    count = nees.shape[0] * nees.shape[2]
    low, high = chi2.ppf((0.025, 0.975), dim * count) / count
    mean = nees.mean((0, 2))
    return float(((mean > low) & (mean < high)).double().mean())


def cloud(process: Process, spread: float, origin: float = 0.0) -> tuple[Tensor, Tensor]:
    """Particles [2, 3, 200, S] about centres [2, 3, S] ``origin`` m from the world's, float32."""
    g = torch.Generator().manual_seed(0)
    centre = torch.randn(2, 3, process.state_size, generator=g)
    centre[..., : process.dim] += origin
    if process.attitude_size == 4:
        centre[..., 6:10] = torch.nn.functional.normalize(centre[..., 6:10], dim=-1)
    delta = spread * torch.randn(2, 3, 200, process.error_size, generator=g)
    return process.boxplus(centre.unsqueeze(2).expand(-1, -1, 200, -1), delta), centre


class Fixes(Measurement):
    """Each UAV's own position: z = p + noise of ``std`` m."""

    std = 0.8

    def linearize(
        self,
        process: Process,
        x: Tensor,
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        d = process.dim
        residual = observation["fix"].to(x.dtype).unsqueeze(-2) - x[..., None, :d]
        jacobian = x.new_zeros(*residual.shape, process.error_size)
        jacobian[..., :d] = torch.eye(d)
        variance = x.new_tensor(self.std**2).expand_as(residual)
        return Block(residual, jacobian, variance, observation["fix_mask"] > 0)


# A linear Gaussian world, where the Kalman filter is the answer. It stands in for a scenario; what
# is measured in it, such as ``fixes``, filters get by replacing their ``make_measurements``.
LINEAR = SimpleNamespace(
    believed=Believed(
        arena=Arena(3, 3, 0.5, (-50.0,) * 3, (50.0,) * 3),
        slots=3,
        process=ConstantVelocity(0.6, 2.0),
        sensors=(),
        prior=Prior(position_std=1.5, velocity_std=0.5),
    ),
    fixes=Fixes(),
)


def change(observation: Observation, **leaves: Tensor) -> Observation:
    """The observation with some leaves replaced."""
    return Observation({**observation.leaves, **leaves})


def masked_pairs(observation: Observation) -> dict[str, str]:
    """Value leaf of each mask leaf."""
    pairs = {}
    for name in observation.leaves:
        if name.endswith("_mask"):
            stem = name.removesuffix("_mask")
            pairs[name] = stem if stem in observation else f"{stem}s"
    return pairs


def behind(observation: Observation, mask: str, value: float) -> Tensor:
    """The value leaf of ``mask`` with ``value`` wherever the mask is 0."""
    leaf, seen = observation[masked_pairs(observation)[mask]], observation[mask]
    entries = leaf.unflatten(-1, (seen.shape[-1], -1))
    return entries.masked_fill(seen.unsqueeze(-1) == 0, value).flatten(-2)


def assert_same(found: Any, expected: Any, tolerance: float = 0.0) -> None:
    """Every tensor of two tensorclasses agrees, exactly unless a tolerance is given."""
    ours, theirs = (x.to_tensordict().flatten_keys(".") for x in (found, expected))
    assert set(ours.keys()) == set(theirs.keys())
    for name, value in ours.items():
        torch.testing.assert_close(
            value,
            theirs[name],
            rtol=tolerance,
            atol=tolerance,
            equal_nan=True,
            msg=lambda m, n=name: f"{n}: {m}",
        )


def _sees_all(name: str) -> bool:
    return getattr(LOCALIZERS[name.split(":")[0]], "centralized", False)


@cache
def recorded(name: str, family: str) -> Case:
    scenario = FAMILIES[family]()
    localizer = build(name, scenario)
    return Case(name, family, scenario, localizer, play(localizer, scenario, SEEDS, STEPS))


def _pairs(cases: list[tuple[str, str]]) -> list[Any]:
    """The cases, those slow that are not in ``SAMPLE``."""
    slow = pytest.mark.slow
    return [pytest.param(c, marks=() if c in SAMPLE else slow, id="-".join(c)) for c in cases]


@pytest.fixture(params=_pairs(CASES))
def case(request: pytest.FixtureRequest) -> Case:
    """Every localizer in every family of scenarios that it takes."""
    return recorded(*request.param)


@pytest.fixture(params=SAMPLE, ids="-".join)
def sample(request: pytest.FixtureRequest) -> Case:
    """Every localizer once, and every family."""
    return recorded(*request.param)


@pytest.fixture(params=_pairs([c for c in CASES if not _sees_all(c[0])]))
def local_case(request: pytest.FixtureRequest) -> Case:
    """Every localizer in which each UAV works for itself, in every family that it takes."""
    return recorded(*request.param)


@pytest.fixture
def tools() -> SimpleNamespace:
    """Running localizers and changing what they see."""
    return SimpleNamespace(
        build=build,
        room=room,
        play=play,
        replay=replay,
        cloud=cloud,
        linear=LINEAR,
        change=change,
        behind=behind,
        masked_pairs=masked_pairs,
        assert_same=assert_same,
        families=FAMILIES,
        score=score,
        consistent=consistent,
    )
