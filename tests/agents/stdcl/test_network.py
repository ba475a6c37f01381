"""The graph network: causal, local, blind to names, places and directions, and gated."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ortho_group
from torch import Tensor

from agents.stdcl.features import SCALARS, Memory, forgotten, look
from agents.stdcl.layers import DilatedConvolution, TopologicalAttention, carried_over
from agents.stdcl.network import DILATIONS, StGnn
from agents.swarm import delays
from agents.swarm.belief import Found, Prepared
from agents.swarm.calibration import believed_model
from agents.swarm.links import Links, lengths, own_information
from agents.swarm.persistence import believed_chain
from agents.weights import untrained

STD, N = 10.0, 14


def stirred(seed: int = 0, **chosen: Any) -> StGnn:
    """A network all of whose weights are random, the last layers' included."""
    network = untrained(StGnn, seed, **chosen).double().requires_grad_(False)
    generator = torch.Generator().manual_seed(seed)
    for weight in network.parameters():
        weight += 0.1 * torch.randn(weight.shape, generator=generator, dtype=torch.float64)
    return network


def moment(seed: int, reach: float = 900.0) -> tuple[Prepared, Found, Tensor, Tensor]:
    """A step of two small teams: what it had, what was found, weights and shifts."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    place = 1000 * torch.rand(2, N, 3, generator=generator, dtype=torch.float64)
    true = lengths(place)
    mask = (true < reach) & ~torch.eye(N, dtype=torch.bool)
    noise = torch.triu(STD * normal(2, N, N), 1)
    fixed = torch.zeros(2, N, dtype=torch.bool)
    fixed[:, :4] = True
    moving = ~fixed.unsqueeze(-1)
    variance = torch.where(fixed, 0.01, 60.0).double()
    now = Prepared(
        state=torch.cat((place, 20 * normal(2, N, 3)), -1),
        place=place + moving * 8 * normal(2, N, 3),
        variance=variance,
        reckoned=variance,
        joint=variance.new_zeros(2, N, 1, 0),
        between=variance.unsqueeze(-1) + variance.unsqueeze(-2),
        drift=None,
        delays=delays.begun(place, None),
        chain=believed_chain(torch.full((2,), 0.1, dtype=torch.float64)),
        added=torch.full((2, N), 0.3, dtype=torch.float64),
        fixed=fixed,
        links=Links((true + noise + noise.mT) * mask, mask),
        model=believed_model(2, STD, torch.device("cpu")),
    )
    found = Found(place + moving * 4 * normal(2, N, 3), torch.where(fixed, 0.01, 20.0).double())
    weight = mask * torch.rand(2, N, N, generator=generator, dtype=torch.float64) / STD**2
    return now, found, 0.5 * (weight + weight.mT), torch.zeros(2, N, N, dtype=torch.float64)


def nothing(n: int = N) -> Memory:
    return forgotten(2, n, 3, torch.device("cpu"))


def reach(found: Found) -> Tensor:
    return 3.0 * found.variance.sqrt()


def answered(network: StGnn, *steps: Any) -> list[Any]:
    """The network's corrections over some steps."""
    memory, past, found = None, None, []
    for now, where, weight, shift in steps:
        memory = nothing(now.fixed.shape[1]) if memory is None else memory
        past = network.start(now.fixed.shape, 3) if past is None else past
        scene, memory = look(now, where, weight, shift, STD, memory, reach(where))
        correction, past = network(scene, past)
        found.append(correction)
    return found


def moved(step: Any, turn: Tensor, by: Tensor) -> Any:
    """The same step in a world that was turned (or mirrored) and shifted."""
    now, found, weight, shift = step
    state = torch.cat((now.state[..., :3] @ turn + by, now.state[..., 3:] @ turn), -1)
    now = replace(now, state=state, place=now.place @ turn + by)
    return now, Found(found.position @ turn + by, found.variance), weight, shift


def renamed(step: Any, order: Tensor) -> Any:
    """The same step with the UAVs in another order."""
    now, found, weight, shift = step

    def pairs(x: Tensor) -> Tensor:
        return x[:, order][:, :, order]

    now = replace(
        now,
        links=Links(pairs(now.links.distance), pairs(now.links.mask)),
        **{k: getattr(now, k)[:, order] for k in ("state", "place", "variance", "added", "fixed")},
    )
    found = Found(found.position[:, order], found.variance[:, order])
    return now, found, pairs(weight), pairs(shift)


@given(st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_corrections_turn_mirror_and_do_not_notice_shifts(seed: int) -> None:
    steps = [moment(seed + k) for k in range(3)]
    turn = torch.tensor(ortho_group.rvs(3, random_state=seed))
    by = torch.tensor([3e3, -2e4, 500.0], dtype=torch.float64)
    network = stirred(seed)
    one = answered(network, *steps)[-1]
    other = answered(network, *(moved(step, turn, by) for step in steps))[-1]
    assert one.offset.norm() > 1.0
    assert torch.allclose(other.offset, one.offset @ turn, rtol=1e-6, atol=1e-6)
    assert torch.allclose(other.spread, one.spread, rtol=1e-7)
    assert torch.allclose(other.confidence, one.confidence, rtol=1e-7)


@given(st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_names_do_not_matter(seed: int) -> None:
    steps = [moment(seed + k) for k in range(3)]
    order = torch.randperm(N, generator=torch.Generator().manual_seed(seed))
    network = stirred(seed)
    one = answered(network, *steps)[-1]
    other = answered(network, *(renamed(step, order) for step in steps))[-1]
    assert torch.allclose(other.offset, one.offset[:, order], rtol=1e-8, atol=1e-9)
    assert torch.allclose(other.confidence, one.confidence[:, order][:, :, order], rtol=1e-8)


def test_lengths_in_other_units_give_the_same_corrections() -> None:
    now, found, weight, shift = moment(4)
    c = 0.01
    state = c * now.state
    links = Links(c * now.links.distance, now.links.mask)
    model = believed_model(2, c * STD, torch.device("cpu"))
    small = replace(
        now,
        state=state,
        place=c * now.place,
        variance=c**2 * now.variance,
        added=c**2 * now.added,
        links=links,
        model=model,
    )
    network = stirred(4)
    (one,) = answered(network, (now, found, weight, shift))
    memory, past = nothing(), network.start(now.fixed.shape, 3)
    scaled = Found(c * found.position, c**2 * found.variance)
    scene, _ = look(small, scaled, weight / c**2, c * shift, c * STD, memory, reach(scaled))
    other, _ = network(scene, past)
    assert torch.allclose(other.offset, c * one.offset, rtol=1e-7, atol=1e-9)


def chain(seed: int) -> Any:
    """A step of a team whose links are a chain: 0 – 1 – 2 – …"""
    now, found, weight, shift = moment(seed, reach=1e9)
    near = torch.arange(N)
    mask = ((near.unsqueeze(0) - near.unsqueeze(1)).abs() == 1).expand(2, -1, -1)
    links = Links(now.links.distance * mask, mask)
    return replace(now, links=links), found, weight * mask, shift


def test_what_is_three_hops_away_is_not_noticed() -> None:
    now, found, weight, shift = chain(1)
    other = now.links.distance.clone()
    other[:, 10, 11] += 30.0
    other[:, 11, 10] += 30.0
    changed = (replace(now, links=Links(other, now.links.mask)), found, weight, shift)
    network = stirred(1)
    (one,), (two,) = (answered(network, step) for step in ((now, found, weight, shift), changed))
    moved = (one.offset - two.offset).norm(dim=-1).amax(0) > 1e-12
    assert moved[10]
    assert moved[11]
    assert not moved[:8].any()  # the ends of the link, and two hops from there
    assert not moved[14:].any()


def test_nothing_is_heard_from_the_future() -> None:
    steps = [moment(k) for k in range(20)]
    network = stirred(2)
    before = answered(network, *steps[:12])
    after = answered(network, *steps)
    for one, other in zip(before, after, strict=False):
        assert torch.equal(one.offset, other.offset)


def test_convolutions_reach_as_far_back_as_they_say() -> None:
    layer = DilatedConvolution(8, 3, 3, 4).double().requires_grad_(False)
    h, v = torch.randn(1, 2, 8).double(), torch.randn(1, 2, 3, 3).double()
    past_h, past_v = torch.randn(1, 2, 8, 8).double(), torch.randn(1, 2, 8, 3, 3).double()
    same, _ = layer(h, v, past_h, past_v)
    for back in range(8):
        other = past_h.clone()
        other[:, :, back] += 1.0
        reaches = bool((layer(h, v, other, past_v)[0] - same).abs().max() > 1e-9)
        assert reaches == (back in (3, 7))


def test_dilated_convolutions_are_torchs() -> None:
    layer = DilatedConvolution(6, 2, 3, 2).double().requires_grad_(False)
    series = torch.randn(1, 1, 30, 6, generator=torch.Generator().manual_seed(0)).double()
    weight = layer.scalars.weight.view(6, 3, 6).permute(0, 2, 1).flip(-1)
    padded = torch.nn.functional.pad(series[0].mT, (4, 0))
    expected = torch.nn.functional.conv1d(padded, weight, layer.scalars.bias, dilation=2)[0].mT
    past, v = torch.zeros(1, 1, 4, 6).double(), torch.zeros(1, 1, 3, 2).double()
    for t in range(30):
        x = series[:, :, t]
        got, _ = layer(x, v, past, torch.zeros(1, 1, 4, 3, 2).double())
        raw = expected[t]
        assert torch.allclose(got[0, 0], x[0, 0] + raw * torch.sigmoid(1.7 * raw))
        past = torch.cat((x.unsqueeze(2), past[:, :, :-1]), 2)


def test_the_receptive_field_in_time() -> None:
    assert sum(one.length for one in StGnn(kernel=2).times) == sum(DILATIONS)  # t − 7 … t
    assert sum(one.length for one in StGnn(kernel=3).times) == 2 * sum(DILATIONS)


def test_attention_is_a_mean_over_links_and_cuts_the_doubtful_and_fast() -> None:
    step = moment(7)
    scene, _ = look(*step, STD, nothing(), reach(step[1]))
    layer = TopologicalAttention(16, scene.vectors.shape[-1], 4).double().requires_grad_(False)
    mapped = torch.randn(2, N, 16, generator=torch.Generator().manual_seed(1)).double()
    share = layer.attention(scene, mapped)
    linked = scene.mask.any(-1)
    assert torch.allclose(share.sum(-1)[linked], torch.ones(int(linked.sum())).double())
    assert (share[~scene.mask] == 0).all()
    link = scene.link.clone()
    link[0, 5, :, -1], link[0, 5, :, -2] = 0.1, 1.0
    far = int(scene.mask[0, 5].nonzero()[0])
    link[0, 5, far, -1], link[0, 5, far, -2] = 9.0, 0.05
    assert layer.attention(replace(scene, link=link), mapped)[0, 5, far] == 0
    link[0, 5, far, -2] = 0.5  # fast, but trusted
    assert layer.attention(replace(scene, link=link), mapped)[0, 5, far] > 0


def test_information_and_carried_displacements_are_what_sums_over_links_give() -> None:
    step = moment(9)
    scene, _ = look(*step, STD, nothing(), reach(step[1]))
    y = scene.position
    unit = (y.unsqueeze(2) - y.unsqueeze(1)) / scene.length.unsqueeze(-1)
    blocks = torch.einsum("bij,bijx,bijy->bixy", scene.weight, unit, unit)
    assert torch.allclose(
        own_information(y, scene.weight, scene.length), blocks, rtol=1e-7, atol=1e-12
    )
    v = torch.randn(2, N, 3, 4, generator=torch.Generator().manual_seed(3)).double()
    pushed = torch.einsum("bij,bijx,bijy,bjyc->bixc", scene.weight, unit, unit, v)
    assert torch.allclose(carried_over(scene, v), scene.gain @ pushed, rtol=1e-6, atol=1e-9)


def test_corrections_are_bounded_and_spare_who_is_fixed() -> None:
    now, found, weight, shift = moment(11)
    network = stirred(11)
    network.out.bias += 1e6
    (correction,) = answered(network, (now, found, weight, shift))
    most = reach(found)
    assert (correction.offset.norm(dim=-1) <= most + 1e-9).all()
    assert (correction.offset[now.fixed] == 0).all()


def test_an_untrained_network_changes_nothing() -> None:
    (correction,) = answered(untrained(StGnn, 0).double(), moment(12))
    assert not correction.offset.any()
    assert torch.equal(correction.spread, torch.ones_like(correction.spread))


@pytest.mark.parametrize("case", ["no links", "one UAV", "all fixed"])
def test_what_is_missing_is_no_number(case: str) -> None:
    now, found, weight, shift = moment(13)
    if case == "no links":
        links = Links(torch.zeros_like(weight), torch.zeros_like(now.links.mask))
        now = replace(now, links=links)
        weight = torch.zeros_like(weight)
    elif case == "one UAV":
        now, found, weight, shift = renamed((now, found, weight, shift), torch.tensor([5]))
    else:
        now = replace(now, fixed=torch.ones_like(now.fixed))
    (correction,) = answered(stirred(13), (now, found, weight, shift))
    assert correction.offset.isfinite().all()
    assert correction.spread.isfinite().all()
    assert len(SCALARS) == 21
