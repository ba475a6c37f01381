"""Who flies where: the paper's two worlds, shares of outliers, teams, particles, hard worlds."""

from typing import Any

from training.reproduce.study import Variant

TITLE = (
    "Arita & Namerikawa, Collaborative Stein Particle Filter for Cooperative Localization in "
    "Monotone Environments"
)
DIMS = (2, 3)
METHODS = (
    *("cspf", "cspf:consensus=false", "cspf:particles=1", "pf_joint:anneal=0.96"),
    "pose_graph:every=50",
)
BESIDE = (
    *("cspf:broadcast=true", "cspf:outliers=0.4", "pf_joint", "pf_joint:particles=5000"),
    *("pf_joint:anneal=0.96:particles=50", "pose_graph:every=50:robust=gnc"),
)
CENTRAL = ("pf_joint:anneal=0.97:particles=500", "pose_graph:every=50:robust=gnc")  # hard worlds
LITERAL = ("cspf:variant=paper", "cspf:variant=paper_corrected")
ACROSS = ("cspf", "cspf:variant=neighbourhood")  # eq. 16 in this filter: thirty times as dear
SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
PUBLISHED = 0.2
EARLY, LATE = 150, 250  # steps after which convergence is looked at
TEAMS = (2, 5, 10, 20)
PARTICLES = (20, 100, 200, 1000)
NAMES = {
    "cspf": "CSPF",
    "cspf:consensus=false": "no consensus",
    "cspf:particles=1": "one particle",
    "pf_joint:anneal=0.96": "annealed PF",
    "pose_graph:every=50": "Huber graph",
}


def world(dim: int, steps: int | None, **overrides: Any) -> Variant:
    """A world of the paper's kind, with overrides."""
    key = "-".join((f"stein{dim}d", *(f"{k}={v}" for k, v in overrides.items())))
    words = ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in overrides.items())
    return Variant(key, f"{dim}-D, {words}", tuple(overrides.items()), f"stein{dim}d-v0", steps)


def published(dim: int, steps: int | None) -> Variant:
    """The paper's own share of outliers."""
    return world(dim, steps, outliers=PUBLISHED)


def shares(steps: int | None) -> list[tuple[Variant, tuple[str, ...]]]:
    """Outliers from none to half."""
    return [(world(dim, steps, outliers=s), METHODS) for dim in DIMS for s in SHARES]


def teams(steps: int | None) -> list[tuple[Variant, tuple[str, ...]]]:
    """More UAVs, one match a step for every two pairs of three."""
    return [(world(2, steps, n_uavs=n, matches_per_step=max(1, n // 3)), METHODS) for n in TEAMS]


def clouds(steps: int | None) -> tuple[Variant, tuple[str, ...]]:
    """More and fewer particles, and the paper's own target."""
    return published(2, steps), (*(f"cspf:particles={m}" for m in PARTICLES), *ACROSS)


def few(runs: int) -> int:
    """Runs of what is dear."""
    return max(1, runs // 10)


def hard(steps: int | None) -> list[tuple[Variant, tuple[str, ...]]]:
    """Where many modes persist, and particles might pay: most matches wrong, half of them among
    many, a ring of equals, blurred matches, a sparse network."""
    worlds: tuple[dict[str, Any], ...] = (
        {"outliers": 0.6},
        {"outliers": 0.75},
        {"outliers": 0.5, "n_uavs": 10, "matches_per_step": 2},
        {"outliers": 0.5, "motion": "circle"},
        {"outliers": 0.4, "relative_pose_noise": (0.3, 15.0)},
        {"outliers": 0.4, "n_uavs": 6, "comm_radius": 5.0, "matches_per_step": 3},
        {"outliers": 0.4, "message_loss": 0.5},
    )
    return [(world(2, steps, **each), (*METHODS, *CENTRAL)) for each in worlds]


def runs_in(variant: Variant, runs: int) -> int:
    """Half of the runs in worlds beyond the paper's; a fifth in teams of more than five, a
    twentieth in those of more than ten, where a step costs twenty times as much."""
    overrides = dict(variant.overrides)
    uavs = overrides.get("n_uavs", 3)
    if uavs > 5:
        return max(1, runs // (20 if uavs > 10 else 5))
    own = overrides.keys() == {"outliers"} and overrides["outliers"] <= 0.5
    return runs if own else max(1, runs // 2)
