"""What may reach whom: unheard UAVs, masked values, NaN, silence, failures, ``cooperate=false``."""

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from agents import LOCALIZERS
from agents.factor_graph.belief import SmootherBelief
from agents.factor_graph.mapped import MappedBelief
from agents.stein.cspf import SteinFilter
from coloc_env.observation import Observation

STRANGER = 1  # the UAV that is cut off, garbled or failing
MAPS = ("prior", "landmark_map", "anchor_map")


def slots_of(observation: Observation, uav: int) -> Tensor:
    """Which of each UAV's neighbour slots [B, N, S] hold the UAV."""
    links = observation["links"]
    if "neighbours" in observation:
        return observation["neighbours"] == uav
    return (torch.arange(links.shape[-1]) == uav).expand(links.shape)


def unheard(observation: Observation, uav: int, change: Any) -> Observation:
    """No link and no message from the UAV to anybody."""
    silent = {
        name: observation[name].masked_fill(slots_of(observation, uav), 0.0)
        for name in ("links", "message_mask")
    }
    return change(observation, **silent)


def garbled(observation: Observation, uav: int, change: Any) -> Observation:
    """Other values in all the UAV senses, receives and is given, and other masks."""
    g = torch.Generator().manual_seed(5)
    leaves = {}
    for name, leaf in observation.leaves.items():
        new = leaf.clone()
        if name.endswith(("_mask", "links")):
            new[:, uav] = torch.rand(new[:, uav].shape, generator=g).round()
        elif name == "prior":
            new[:, uav, :2] += 1.0
        elif name not in (*MAPS, "neighbours"):
            new[:, uav] += 0.3 * torch.randn(new[:, uav].shape, generator=g)
        leaves[name] = new
    return change(observation, **leaves)


def others(run: Any, uav: int) -> list[Any]:
    """Estimates and beliefs of all but the UAV."""
    keep = [i for i in range(run.estimates[0].batch_size[1]) if i != uav]
    return [x[:, keep] for x in (*run.estimates, *run.beliefs)]


def assert_unmoved(
    found: Sequence[Any], expected: Sequence[Any], same: Any, tolerance: float = 0.0
) -> None:
    for one, other in zip(found, expected, strict=True):
        same(one, other, tolerance)


# ---------------------------------------------------------------- locality


def test_nobody_knows_of_a_uav_that_nobody_hears(
    local_case: SimpleNamespace, tools: SimpleNamespace
) -> None:
    case = local_case
    alone = [unheard(o, STRANGER, tools.change) for o in case.run.observations]
    base = tools.replay(case.localizer, alone)
    moved = tools.replay(case.localizer, [garbled(o, STRANGER, tools.change) for o in alone])
    assert_unmoved(others(moved, STRANGER), others(base, STRANGER), tools.assert_same)
    assert not torch.equal(moved.position[:, :, STRANGER], base.position[:, :, STRANGER])


def test_a_uav_needs_no_row_but_its_own(
    local_case: SimpleNamespace, tools: SimpleNamespace
) -> None:
    case = local_case
    if case.family == "tags":
        pytest.skip("lever arms go by row: a team of some UAVs only is another scenario")
    if case.localizer.exchanges:
        pytest.skip("needs the rows of the UAVs that it hears")
    for rows in ([0, 2], [STRANGER]):
        part = [
            Observation({name: leaf[:, rows] for name, leaf in o.leaves.items()})
            for o in case.run.observations
        ]
        alone = tools.replay(case.localizer, part)
        assert_unmoved(alone.estimates, [e[:, rows] for e in case.run.estimates], tools.assert_same)


def test_neighbours_are_used_where_they_are_heard(
    local_case: SimpleNamespace, tools: SimpleNamespace
) -> None:
    """Or the tests above could not fail: other messages make other estimates."""
    case = local_case
    if "cooperate" not in LOCALIZERS.options_of(case.name.split(":")[0]):
        pytest.skip("does not cooperate")
    if any(name in case.name for name in ("pairwise", "exchange")):
        pytest.skip("beliefs and measurements are exchanged, not messages")
    if case.family in ("wsn", "stein2d"):
        pytest.skip("no range or bearing is measured between UAVs")
    d, garbled_messages = case.scenario.arena.dim, []
    for o in case.run.observations:
        messages = o["messages"].unflatten(-1, (-1, 3 * d)).clone()
        messages[..., 0] += 2.0
        messages[..., 2 * d :] = -6.0
        garbled_messages.append(tools.change(o, messages=messages.flatten(-2)))
    moved = tools.replay(case.localizer, garbled_messages)
    assert (moved.position[-1] - case.run.position[-1]).abs().max() > 1e-3


@pytest.mark.parametrize("family", ["default", "slots", "plane"])
@pytest.mark.parametrize("name", [n for n in LOCALIZERS if "cooperate" in LOCALIZERS.options_of(n)])
def test_without_cooperation_other_uavs_do_not_matter(
    name: str, family: str, tools: SimpleNamespace
) -> None:
    scenario = tools.families[family]()
    if (name, family) in (("ekf_joint", "slots"), ("dlspf", "plane")):
        pytest.skip("refuses large teams, or motion in the plane")
    localizer = tools.build(f"{name}:cooperate=false", scenario)
    run = tools.play(localizer, scenario, [0, 1], 5)
    leaves = ("ranges", "range_mask", "uav_bearings", "uav_bearing_mask", "messages")
    leaves += ("message_mask", "links", "neighbours")
    apart = [
        tools.change(o, **{name: torch.rand_like(o[name]).round() for name in leaves if name in o})
        for o in run.observations
    ]
    moved = tools.replay(localizer, apart)
    assert_unmoved(
        (*moved.estimates, *moved.beliefs), (*run.estimates, *run.beliefs), tools.assert_same
    )


# ---------------------------------------------------------------- masks


def half_masked(observation: Observation, tools: SimpleNamespace) -> Observation:
    """Half of what arrived counts as missing."""
    g = torch.Generator().manual_seed(3)
    kept = {
        mask: observation[mask] * torch.rand(observation[mask].shape, generator=g).round()
        for mask in tools.masked_pairs(observation)
    }
    return tools.change(observation, **kept)


def believed(run: Any) -> list[Any]:
    """Beliefs, without windows of what was seen as it was seen."""
    mains = [getattr(belief, "main", belief) for belief in run.beliefs]
    mains = [getattr(belief, "reckoned", belief) for belief in mains]

    def without(belief: Any) -> Any:
        if isinstance(belief, MappedBelief):
            return belief.replace(track=without(belief.track))
        if isinstance(belief, SmootherBelief):
            return belief.replace(window=torch.zeros_like(belief.window))
        return belief

    return [without(belief) for belief in mains]


def test_values_behind_a_mask_change_nothing(case: SimpleNamespace, tools: SimpleNamespace) -> None:
    seen = [half_masked(o, tools) for o in case.run.observations]

    def filled(value: float) -> Any:
        return [
            tools.change(
                o,
                **{leaf: tools.behind(o, m, value) for m, leaf in tools.masked_pairs(o).items()},
            )
            for o in seen
        ]

    base, moved = (tools.replay(case.localizer, filled(value)) for value in (0.0, 1e6))
    assert_unmoved(moved.estimates, base.estimates, tools.assert_same)
    assert_unmoved(believed(moved), believed(base), tools.assert_same)


def test_silence_leaves_the_motion_model(case: SimpleNamespace, tools: SimpleNamespace) -> None:
    """No measurement for a while: estimates stay finite and do not grow certain."""
    observations = case.run.observations
    blind = {
        mask: torch.zeros_like(observations[0][mask])
        for mask in tools.masked_pairs(observations[0])
    }
    silent = [tools.change(o, **blind) for o in observations[2:]] * 3
    run = tools.replay(case.localizer, [*observations[:2], *silent, observations[-1]])
    spread = [e.covariance.diagonal(dim1=-2, dim2=-1).sum(-1).double() for e in run.estimates]
    assert all(e.position.isfinite().all() for e in run.estimates)
    assert spread[-2].sum() > 0.8 * spread[1].sum()  # of few particles, too
    assert run.estimates[-1].position.isfinite().all()


# ---------------------------------------------------------------- what goes wrong


def test_nan_stays_with_the_uav_that_saw_it(case: SimpleNamespace, tools: SimpleNamespace) -> None:
    assert_kept_apart(math.nan, case, tools)


def test_infinity_stays_with_the_uav_that_saw_it(
    sample: SimpleNamespace, tools: SimpleNamespace
) -> None:
    assert_kept_apart(math.inf, sample, tools)


def assert_kept_apart(bad: float, case: SimpleNamespace, tools: SimpleNamespace) -> None:
    """For centralized ones: within its world, but for the rounding of systems of another size."""
    if isinstance(case.localizer, SteinFilter):
        pytest.skip("a UAV's motion is what it tells of it; test_cspf has what then holds")
    spoiled = list(case.run.observations)
    for k in (1, 2):
        leaves = {name: leaf.clone() for name, leaf in spoiled[k].leaves.items()}
        for name, leaf in leaves.items():
            if name not in (*MAPS, "neighbours"):
                leaf[0, STRANGER] = bad
        spoiled[k] = Observation(leaves)
    run = tools.replay(case.localizer, spoiled)
    if getattr(case.localizer, "shared", ()):  # others do without its graph
        assert all(x.position.isfinite().all() for x in others(run, STRANGER)[: len(spoiled)])
        apart = run.position[-1] - case.run.position[-1]
        assert apart[1].abs().max() == 0.0
        assert apart[0, [i for i in range(len(apart[0])) if i != STRANGER]].abs().max() < 0.5
        return
    if case.localizer.centralized:
        found, expected = ([x[1:] for x in (*r.estimates, *r.beliefs)] for r in (run, case.run))
    else:
        found, expected = (others(r, STRANGER) for r in (run, case.run))
    if any(f"fusion={name}" in case.name for name in ("ci", "pairwise", "exchange")):
        for one in others(run, STRANGER)[: len(run.estimates)]:  # they do without its belief
            assert one.position.isfinite().all()
            assert one.covariance.isfinite().all()
        return
    tolerance = 1e-9 if case.localizer.centralized else 0.0
    assert_unmoved(found, expected, tools.assert_same, tolerance)


def test_a_failing_uav_takes_nobody_with_it(
    sample: SimpleNamespace, tools: SimpleNamespace
) -> None:
    """It goes silent and senses zeros; the others go on about as they would with it."""
    failing = replace(sample.scenario, failures=((STRANGER, 2),))
    run = tools.play(sample.localizer, failing, (3, 4), len(sample.run.estimates))
    assert not run.observations[2]["links"][:, STRANGER].any()
    keep = [i for i in range(run.position.shape[2]) if i != STRANGER]
    for estimate in run.estimates:
        assert estimate.position.isfinite().all()
        assert (torch.linalg.eigvalsh(estimate.covariance[:, keep].double()) > 0).all()
    apart = (run.position - sample.run.position)[-1][:, keep].norm(dim=-1)
    limit = 1.0 if sample.family == "ranges" else 0.5  # without landmarks and anchors teams float
    assert apart.median() < limit
