"""The graph network: causal, local, equivariant to permutations and rotations, and gated."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ortho_group
from torch import Tensor

from agents.stdcl.features import SCALARS, RunningMeans, graph_inputs, initial_means
from agents.stdcl.layers import DilatedConvolution, TopologicalAttention, pushed_by_ranges
from agents.stdcl.network import StGnn
from agents.swarm import delays
from agents.swarm.belief import Solution, StepInput
from agents.swarm.calibration import prior_model
from agents.swarm.links import Links, lengths, own_information
from agents.swarm.persistence import prior_counts
from agents.weights import untrained

STD, N = 10.0, 14


def randomized(seed: int = 0, **chosen: Any) -> StGnn:
    """A network all of whose weights are random, the last layers' included."""
    network = untrained(StGnn, seed, **chosen).double().requires_grad_(False)
    generator = torch.Generator().manual_seed(seed)
    for weight in network.parameters():
        weight += 0.1 * torch.randn(weight.shape, generator=generator, dtype=torch.float64)
    return network


def step_of(seed: int, reach: float = 900.0) -> tuple[StepInput, Solution, Tensor, Tensor]:
    """A step of two small teams: its inputs, a solution, weights and shifts, as matrices."""
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
    inputs = StepInput(
        state=torch.cat((place, 20 * normal(2, N, 3)), -1),
        prior=place + moving * 8 * normal(2, N, 3),
        variance=variance,
        predicted_variance=variance,
        joint=variance.new_zeros(2, N, 1, 0),
        pair_variance=variance.unsqueeze(-1) + variance.unsqueeze(-2),
        ins_bias=None,
        delays=delays.initial(place, None),
        transitions=prior_counts(torch.full((2,), 0.1, dtype=torch.float64)),
        process_noise=torch.full((2, N), 0.3, dtype=torch.float64),
        fixed=fixed,
        links=Links((true + noise + noise.mT) * mask, mask),
        error_model=prior_model(2, STD, torch.device("cpu")),
    )
    found = Solution(place + moving * 4 * normal(2, N, 3), torch.where(fixed, 0.01, 20.0).double())
    weight = mask * torch.rand(2, N, N, generator=generator, dtype=torch.float64) / STD**2
    return inputs, found, 0.5 * (weight + weight.mT), torch.zeros(2, N, N, dtype=torch.float64)


def no_means(n: int = N) -> RunningMeans:
    return initial_means(2, n, 3, torch.device("cpu"))


def max_offset(solution: Solution) -> Tensor:
    return 3.0 * solution.variance.sqrt()


def graph_of(step: Any, means: RunningMeans | None = None, std: float = STD) -> Any:
    """The network's inputs for a step, and the running means after it."""
    inputs, found, weight, shift = step
    of = inputs.links.pairs.of
    means = no_means(inputs.fixed.shape[1]) if means is None else means
    given = of(weight), of(shift)
    return graph_inputs(inputs, found, lambda _: given, std, means, max_offset(found))


def corrections(network: StGnn, *steps: Any) -> list[Any]:
    """The network's corrections over some steps."""
    means, past, found = None, None, []
    for inputs, where, weight, shift in steps:
        means = no_means(inputs.fixed.shape[1]) if means is None else means
        past = network.start(inputs.fixed.shape, 3) if past is None else past
        graph, means = graph_of((inputs, where, weight, shift), means)
        correction, past = network(graph, past)
        found.append(correction)
    return found


def moved(step: Any, turn: Tensor, by: Tensor) -> Any:
    """The same step in a world that was turned (or mirrored) and shifted."""
    inputs, found, weight, shift = step
    state = torch.cat((inputs.state[..., :3] @ turn + by, inputs.state[..., 3:] @ turn), -1)
    inputs = replace(inputs, state=state, prior=inputs.prior @ turn + by)
    return inputs, Solution(found.position @ turn + by, found.variance), weight, shift


def permuted(step: Any, order: Tensor) -> Any:
    """The same step with the UAVs in another order."""
    inputs, found, weight, shift = step

    def pairs(x: Tensor) -> Tensor:
        return x[:, order][:, :, order]

    inputs = replace(
        inputs,
        links=Links(pairs(inputs.links.distance), pairs(inputs.links.mask)),
        **{
            k: getattr(inputs, k)[:, order]
            for k in ("state", "prior", "variance", "process_noise", "fixed")
        },
    )
    found = Solution(found.position[:, order], found.variance[:, order])
    return inputs, found, pairs(weight), pairs(shift)


@given(st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_corrections_are_equivariant_to_rotations_and_invariant_to_translations(seed: int) -> None:
    steps = [step_of(seed + k) for k in range(3)]
    turn = torch.tensor(ortho_group.rvs(3, random_state=seed))
    by = torch.tensor([3e3, -2e4, 500.0], dtype=torch.float64)
    network = randomized(seed)
    one = corrections(network, *steps)[-1]
    other = corrections(network, *(moved(step, turn, by) for step in steps))[-1]
    assert one.offset.norm() > 1.0
    assert torch.allclose(other.offset, one.offset @ turn, rtol=1e-6, atol=1e-6)
    assert torch.allclose(other.variance_factor, one.variance_factor, rtol=1e-7)
    assert torch.allclose(other.confidence, one.confidence, rtol=1e-7)


@given(st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_corrections_are_equivariant_to_permutations(seed: int) -> None:
    steps = [step_of(seed + k) for k in range(3)]
    order = torch.randperm(N, generator=torch.Generator().manual_seed(seed))
    network = randomized(seed)
    one = corrections(network, *steps)[-1]
    other = corrections(network, *(permuted(step, order) for step in steps))[-1]
    assert torch.allclose(other.offset, one.offset[:, order], rtol=1e-8, atol=1e-9)
    pairs = [step[0].links.pairs for step in (steps[-1], permuted(steps[-1], order))]
    trust = [
        each.matrix((found.confidence * each.there).unsqueeze(1))
        for each, found in zip(pairs, (one, other), strict=True)
    ]
    assert torch.allclose(trust[1], trust[0][:, order][:, :, order], rtol=1e-8)


def test_lengths_in_other_units_give_the_same_corrections() -> None:
    inputs, found, weight, shift = step_of(4)
    c = 0.01
    state = c * inputs.state
    links = Links(c * inputs.links.distance, inputs.links.mask)
    model = prior_model(2, c * STD, torch.device("cpu"))
    small = replace(
        inputs,
        state=state,
        prior=c * inputs.prior,
        variance=c**2 * inputs.variance,
        process_noise=c**2 * inputs.process_noise,
        links=links,
        error_model=model,
    )
    network = randomized(4)
    (one,) = corrections(network, (inputs, found, weight, shift))
    means, past = no_means(), network.start(inputs.fixed.shape, 3)
    scaled = Solution(c * found.position, c**2 * found.variance)
    graph, _ = graph_of((small, scaled, weight / c**2, c * shift), means, c * STD)
    other, _ = network(graph, past)
    assert torch.allclose(other.offset, c * one.offset, rtol=1e-7, atol=1e-9)


def chain(seed: int) -> Any:
    """A step of a team whose links are a chain: 0 – 1 – 2 – …"""
    inputs, found, weight, shift = step_of(seed, reach=1e9)
    near = torch.arange(N)
    mask = ((near.unsqueeze(0) - near.unsqueeze(1)).abs() == 1).expand(2, -1, -1)
    links = Links(inputs.links.distance * mask, mask)
    return replace(inputs, links=links), found, weight * mask, shift


def test_a_change_three_hops_away_has_no_effect() -> None:
    inputs, found, weight, shift = chain(1)
    other = inputs.links.distance.clone()
    other[:, 10, 11] += 30.0
    other[:, 11, 10] += 30.0
    changed = (replace(inputs, links=Links(other, inputs.links.mask)), found, weight, shift)
    network = randomized(1)
    (one,), (two,) = (
        corrections(network, step) for step in ((inputs, found, weight, shift), changed)
    )
    moved = (one.offset - two.offset).norm(dim=-1).amax(0) > 1e-12
    assert moved[10]
    assert moved[11]
    assert not moved[:8].any()  # the ends of the link, and two hops from there
    assert not moved[14:].any()


def test_corrections_are_causal() -> None:
    steps = [step_of(k) for k in range(20)]
    network = randomized(2)
    before = corrections(network, *steps[:12])
    after = corrections(network, *steps)
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
    assert sum(one.length for one in StGnn(kernel=2).times) == 1 + 2 + 4  # t − 7 … t
    assert sum(one.length for one in StGnn(kernel=3).times) == 2 * (1 + 2 + 4)


def attention_of(step: Any, **chosen: Any) -> tuple[TopologicalAttention, Any, Tensor]:
    """A layer, a step's graph and W h for it."""
    graph, _ = graph_of(step)
    layer = TopologicalAttention(16, graph.vectors.shape[-1], 4, **chosen)
    mapped = torch.randn(2, N, 16, generator=torch.Generator().manual_seed(1)).double()
    return layer.double().requires_grad_(False), graph, mapped


def test_attention_is_a_mean_over_links() -> None:
    layer, graph, mapped = attention_of(step_of(7))
    share = graph.pairs.matrix(layer.attention(graph, mapped))
    mask = graph.pairs.matrix(graph.pairs.there.double().unsqueeze(1)) > 0
    linked = mask.any(-1)
    assert torch.allclose(share.sum(-1)[linked], torch.ones(int(linked.sum())).double())
    assert (share[~mask] == 0).all()


@pytest.mark.parametrize(
    ("speed", "confidence", "is_cut"),
    [(90.0, 0.3, True), (90.0, 0.9, False), (10.0, 0.3, False)],
)
def test_a_link_is_cut_whose_ends_part_quickly_and_that_is_doubted(
    speed: float, confidence: float, is_cut: bool
) -> None:
    """One UAV moves at ``speed`` away from others at 10 m/s; the cut works in m/s, not in their
    logarithms, of which none is twice the mean."""
    inputs, found, _, shift = step_of(7)
    state = inputs.state.clone()
    state[..., 3:] = torch.tensor([10.0, 0.0, 0.0]).double()
    state[:, ::2, 3:] = torch.tensor([0.0, 10.0, 0.0]).double()
    state[:, 5, 3:] = torch.tensor([0.0, 0.0, -speed]).double()
    weight = inputs.links.mask.double() / STD**2
    weight[:, 5], weight[:, :, 5] = confidence * weight[:, 5], confidence * weight[:, :, 5]
    step = (replace(inputs, state=state), found, weight, shift)
    layer, graph, mapped = attention_of(step)
    mask = inputs.links.mask
    others = mask.clone()
    others[:, 5] = False
    to_it = others & (torch.arange(N) == 5)
    share = graph.pairs.matrix(layer.attention(graph, mapped))
    assert to_it.any()
    assert bool((share[to_it] == 0).all()) == is_cut
    assert (share[mask & ~to_it & others] > 0).all()
    keeping, _, _ = attention_of(step, cut=False)
    assert (graph.pairs.matrix(keeping.attention(graph, mapped))[mask] > 0).all()


def test_information_and_pushed_displacements_are_sums_over_links() -> None:
    step = step_of(9)
    graph, _ = graph_of(step)
    y, weight = graph.position, graph.pairs.matrix(graph.weight)
    unit = (y.unsqueeze(2) - y.unsqueeze(1)) / lengths(y).unsqueeze(-1)
    blocks = torch.einsum("bij,bijx,bijy->bixy", weight, unit, unit)
    assert torch.allclose(own_information(y, graph.coupling), blocks, rtol=1e-7, atol=1e-12)
    v = torch.randn(2, N, 3, 4, generator=torch.Generator().manual_seed(3)).double()
    pushed = torch.einsum("bij,bijx,bijy,bjyc->bixc", weight, unit, unit, v)
    assert torch.allclose(pushed_by_ranges(graph, v), graph.gain @ pushed, rtol=1e-6, atol=1e-9)


def test_corrections_are_bounded_and_anchors_stay() -> None:
    inputs, found, weight, shift = step_of(11)
    network = randomized(11)
    network.out.bias += 1e6
    (correction,) = corrections(network, (inputs, found, weight, shift))
    most = max_offset(found)
    assert (correction.offset.norm(dim=-1) <= most + 1e-9).all()
    assert (correction.offset[inputs.fixed] == 0).all()


def test_an_untrained_network_changes_nothing() -> None:
    (correction,) = corrections(untrained(StGnn, 0).double(), step_of(12))
    assert not correction.offset.any()
    assert torch.equal(correction.variance_factor, torch.ones_like(correction.variance_factor))


@pytest.mark.parametrize("case", ["no links", "one UAV", "all fixed"])
def test_corrections_are_finite_whatever_is_missing(case: str) -> None:
    inputs, found, weight, shift = step_of(13)
    if case == "no links":
        links = Links(torch.zeros_like(weight), torch.zeros_like(inputs.links.mask))
        inputs = replace(inputs, links=links)
        weight = torch.zeros_like(weight)
    elif case == "one UAV":
        inputs, found, weight, shift = permuted((inputs, found, weight, shift), torch.tensor([5]))
    else:
        inputs = replace(inputs, fixed=torch.ones_like(inputs.fixed))
    (correction,) = corrections(randomized(13), (inputs, found, weight, shift))
    assert correction.offset.isfinite().all()
    assert correction.variance_factor.isfinite().all()
    assert len(SCALARS) == 21
