"""Localizers by name: what exists, which options each takes, and building one for a scenario."""

from __future__ import annotations

import inspect
import warnings
from functools import cache
from typing import TYPE_CHECKING, Any

from agents.errors import NotServed
from coloc_env import options
from coloc_env.registry import Factory, Registry

if TYPE_CHECKING:
    from agents.localizer import Localizer
    from coloc_env.scenario import Believed, Scenario


LOCALIZERS = Registry(
    "agent",
    "coloc.localizers",
    {
        "apf": "agents.particle.apf:AdaptiveParticleFilter",
        "cspf": "agents.stein.cspf:SteinFilter",
        "dead_reckoning": "agents.kalman.dead_reckoning:DeadReckoning",
        "dfgo": "agents.factor_graph.dfgo:DistributedFactorGraph",
        "dfgo_central": "agents.factor_graph.dfgo_central:CentralFactorGraph",
        "dlspf": "agents.particle.dlspf:LatentParticleFilter",
        "dwmds": "agents.swarm.dwmds:CostaMds",
        "dwmds_st": "agents.swarm.dwmds_st:DynamicMds",
        "ekf": "agents.kalman.ekf:CooperativeEkf",
        "ekf_joint": "agents.kalman.ekf_joint:JointEkf",
        "ekf_trust": "agents.trust.ekf_trust:TrustingEkf",
        "emvf": "agents.kalman.emvf:MinimumVarianceFir",
        "fcmds": "agents.swarm.fcmds:FullyConnectedMds",
        "gn": "agents.swarm.gn:Snapshot",
        "hpff": "agents.particle.hpff:Hpff",
        "ippo": "agents.policies.ippo:Ippo",
        "map": "agents.swarm.map:RecursiveMap",
        "mappo": "agents.policies.mappo:Mappo",
        "mhekf": "agents.kalman.mhekf:MultiHypothesisEkf",
        "mds": "agents.swarm.mds:MdsMap",
        "nnhpff": "agents.particle.nnhpff:NeuralHpff",
        "pf": "agents.particle.pf:Pf",
        "pf500": "agents.particle.pf:Pf500",
        "pf800": "agents.particle.pf:Pf800",
        "pf_auxiliary": "agents.particle.auxiliary:AuxiliaryParticleFilter",
        "pf_corrected": "agents.particle.pf_corrected:CorrectedParticleFilter",
        "pf_joint": "agents.particle.pf_joint:TeamParticleFilter",
        "pf_mixture": "agents.particle.mixture:MixtureParticleFilter",
        "pf_rao_blackwell": "agents.particle.rao_blackwell:RaoBlackwellFilter",
        "pf_trust": "agents.trust.pf_trust:TrustingParticleFilter",
        "pfnn": "agents.particle.pfnn:NeuralParticleFilter",
        "pose_graph": "agents.factor_graph.pose_graph:PoseGraph",
        "sb3-ppo": "agents.policies.sb3_ppo:Sb3Ppo",
        "slam": "agents.slam.slam:Slam",
        "slam_central": "agents.slam.slam_central:CentralSlam",
        "stdcl": "agents.stdcl.stdcl:StDcl",
        "stein_vi": "agents.stein.stein_vi:SteinViFilter",
        "stgat": "agents.stdcl.stgat:StGat",
        "ukf": "agents.kalman.ukf:UnscentedFilter",
        "vmds": "agents.swarm.vmds:VelocityMds",
    },
)


def make(name: str, scenario: Scenario | Believed, **chosen: Any) -> Localizer:
    """Build a localizer for what the scenario's team believes (or for those beliefs).

    ``name`` may carry options as on the command line (``"ekf:robust=huber"``); a piece without "="
    belongs to the option before, and so does one that names no option where either is a path: paths
    may have colons. Raises ValueError, in one line that names what is allowed, for an unknown name
    or option; ``NotServed`` for a team that measures what the localizer would ignore, or lacks what
    it needs.
    """
    name, *pieces = name.split(":")
    factory = LOCALIZERS.require(name)
    known = LOCALIZERS.options_of(name)
    texts: list[str] = []
    for piece in pieces:
        key, given, _ = piece.partition("=")
        if texts and (not given or (key not in known and _is_path(texts[-1], piece))):
            texts[-1] += f":{piece}"
        else:
            texts.append(piece)
    chosen = options.checked(name, options.parse_all(name, texts, known, chosen), known)
    believed: Believed = getattr(scenario, "believed", scenario)  # type: ignore[arg-type]
    _require_served(name, factory, believed)
    build = getattr(factory, "for_team", factory)
    keywords = options.grouped(factory, chosen)
    _require_localizer(name, build, believed, keywords)
    try:
        made: Localizer = build(believed, **keywords)
    except ValueError as error:
        text, kind = str(error), NotServed if isinstance(error, NotServed) else ValueError
        raise kind(text if text.startswith(name) else f"{name}: {text}") from error
    if not (hasattr(made, "reset") and hasattr(made, "step")):
        raise ValueError(f"{name}: a Localizer is needed, not {type(made).__name__}")
    return made


def make_inner(name: str, scenario: Scenario | Believed) -> Localizer:
    """Build a localizer that another thing's option names, whose own options follow ``@`` there:
    ``ekf@robust=huber``."""
    return make(name.replace("@", ":"), scenario)


def _is_path(*texts: str) -> bool:
    return any("/" in text or ".safetensors" in text for text in texts)


def _require_localizer(
    name: str, build: Factory, believed: Believed, keywords: dict[str, Any]
) -> None:
    """Raise ValueError for what cannot be called as a localizer's class is."""
    try:
        inspect.signature(build).bind(believed, **keywords)
    except TypeError as error:
        what = "a Localizer is made of a team's beliefs and its own options"
        raise ValueError(f"{name}: {what}: {error}") from error
    missing = ", ".join(sorted(getattr(build, "__abstractmethods__", ())))
    if missing:
        raise ValueError(f"{name}: {build.__name__} lacks what a Localizer has: {missing}")


def _require_served(name: str, factory: Factory, believed: Believed) -> None:
    """Raise NotServed if a localizer would ignore what the team measures; name those that fit.

    One that uses whatever has a measurement model goes on without a sensor that has none, as long
    as something is left to use, and warns of it.
    """
    from agents.models.measurements import model_of

    ignored = _ignored(factory, believed)
    if not ignored:
        return
    used = {type(one).__name__ for one in believed.sensors if model_of(type(one))}
    general = getattr(factory, "serves", None) is None
    if general and used and used.isdisjoint(ignored):
        for sensor in ignored:
            _warn_of_unmodelled(sensor)
    else:
        others = [one for one in LOCALIZERS if _fits(one, believed)]
        raise NotServed(
            f"{name}: what the team measures with {', '.join(ignored)} would be ignored; "
            f"these use it: {', '.join(others) or 'none'}"
        )


@cache
def _warn_of_unmodelled(sensor: str) -> None:
    """Once for each kind of sensor, however many localizers are made."""
    warnings.warn(
        f"{sensor} has no measurement model: localizers do not use it "
        "(agents.models.measurements.measures registers one)",
        stacklevel=4,
    )


def _fits(name: str, believed: Believed) -> bool:
    """Whether a localizer is there and uses all that the team measures."""
    try:
        return not _ignored(LOCALIZERS[name], believed)
    except ValueError:  # of a package that is broken
        return False


def _ignored(factory: Factory, believed: Believed) -> list[str]:
    ignores = getattr(factory, "ignores", None)
    return [] if ignores is None else ignores(believed)
