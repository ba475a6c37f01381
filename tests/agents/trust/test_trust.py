"""Learned trust: what its networks see, what they may change, and what the shipped ones catch."""

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from agents import make
from agents.kalman.filter import predict
from agents.models.measurements import Block, LandmarkVectors, UavRanges, received
from agents.particle.likelihood import log_likelihood
from agents.robust import Prediction, Trust
from agents.trust.features import features, innovation, leave_one_out
from agents.trust.network import TrustNetwork
from agents.weights import learned
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from tests.sampling import crossed

LANDMARKS, RANGES = 0, 1  # the blocks of indoor-v0
PER_LINK = 3  # numbers remembered of each


def watched(name: str, scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, list]:
    """A localizer, and the (blocks, trusts) of each of its updates' last iterations."""
    localizer: Any = make(name, scenario)
    seen: list = []
    weigh = localizer.screen.weigh

    def watch(blocks: Sequence[Any], evidence: Any, last: bool) -> list[Trust]:
        trusts = weigh(blocks, evidence, last)
        if last:
            seen.append((blocks, trusts))
        return trusts

    monkeypatch.setattr(localizer.screen, "weigh", watch)
    return localizer, seen


def constant(localizer: Any, weight: float | None, bias: float | None) -> None:
    """Networks that say the same of every measurement: logit of a weight, inverse softplus of a
    bias; untrained ones where None."""
    network = TrustNetwork().requires_grad_(False)
    if weight is not None:
        network.vectors[-1].bias[0] = weight
        network.ranges[-1].bias[0] = weight
    if bias is not None:
        network.ranges[-1].bias[1] = bias
    localizer.screen.network = network


# ---------------------------------------------------------------- features


@st.composite
def masked_rows(draw: Callable) -> tuple[list[float], list[bool]]:
    m = draw(st.integers(1, 20))
    values = st.floats(-50, 50, width=32)
    rows = (st.lists(kind, min_size=m, max_size=m) for kind in (values, st.booleans()))
    x, seen = (draw(row) for row in rows)
    return x, seen


@given(masked_rows())
@settings(deadline=None, max_examples=200)
def test_leave_one_out_is_a_loop(row: tuple[list[float], list[bool]]) -> None:
    x, seen = row
    tensors = torch.tensor([x], dtype=torch.float64), torch.tensor([seen], dtype=torch.float64)
    mean, median = leave_one_out(*tensors)
    for i in range(len(x)):
        others = [x[j] for j in range(len(x)) if seen[j] and j != i]
        if not others:
            assert float(median[0, i]) == 0
            assert float(mean[0, i]) == pytest.approx(0, abs=1e-9)
            continue
        assert float(median[0, i]) == statistics.median_low(others)
        assert float(mean[0, i]) == pytest.approx(statistics.fmean(others), abs=1e-9)


def test_untrained_networks_trust_nearly_all() -> None:
    network, seen = TrustNetwork(), torch.randn(2, 3, 7, 15)
    assert sum(p.numel() for p in network.parameters()) < 3500
    torch.testing.assert_close(network.trust_vectors(seen[..., :12]), torch.full((2, 3, 7), 0.98))
    weight, bias = network.trust_ranges(seen)
    torch.testing.assert_close(weight, torch.full((2, 3, 7), 0.98))
    assert ((bias > 0) & (bias < 0.02)).all()


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_weights_are_shares_and_biases_never_negative(scale: float) -> None:
    torch.manual_seed(0)
    network = TrustNetwork().requires_grad_(False)
    for parameter in network.parameters():
        parameter.copy_(torch.randn(parameter.shape))
    seen = scale * torch.randn(2, 3, 500, 15)
    weight, bias = network.trust_ranges(seen)
    for share in (weight, network.trust_vectors(seen[..., :12])):
        assert ((share >= 0) & (share <= 1)).all()
    assert (bias >= 0).all()
    assert bias.max() > 1
    assert weight.min() < 0.01


@given(st.floats(0.02, 50.0), st.integers(0, 10**6), st.sampled_from([1, 2, 3]))
@settings(deadline=None, max_examples=60)
def test_scaling_all_lengths_changes_no_feature(scale: float, seed: int, k: int) -> None:
    """Ranges (k = 1), range and bearing (k = 2, whose second number is an angle), vectors (k = 3),
    of a prior in metres and radians."""
    g = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    root, h, memory = draw(1, 1, 4, 4), draw(1, 1, 5, k, 4), draw(1, 1, 5, 3).square()
    r, noise, theirs = draw(1, 1, 5, k), *(draw(1, 1, 5, k).square() + 0.1 for _ in range(2))
    mask, std = torch.rand(1, 1, 5, generator=g) > 0.2, draw(1, 1).exp()
    found = []
    for length in (1.0, scale):
        of_error = torch.tensor([length, length, length, 1.0])  # the last is an angle
        of_number = torch.tensor([length, 1.0] if k == 2 else [length] * k)
        block = Block(
            residual=r * of_number,
            jacobian=h * of_number.unsqueeze(-1) / of_error,
            variance=noise * of_number**2,
            mask=mask,
            partner_variance=theirs * of_number**2,
        )
        covariance = (root @ root.mT) * of_error * of_error.unsqueeze(-1)
        first = innovation(block, covariance, relative=True)
        own_std, counts = (length * std).log(), [std, std, std]
        found.append(features(block, first, own_std, counts, memory, relative=True))
    torch.testing.assert_close(found[1], found[0], rtol=1e-6, atol=1e-6)


def test_scaling_a_world_changes_no_weight(tools: SimpleNamespace) -> None:
    """Room, landmarks, noise, speeds and prior ten times as large, and the same draws."""
    network = learned(TrustNetwork, "trust_bank").requires_grad_(False)
    assert network.relative
    small = make_scenario("indoor-v0", uwb_std=0.2, nlos=0.3, n_uavs=3)
    localizer: Any = make("ekf_trust:bank=false:weights=none", small)
    localizer.learn(network)
    run = tools.play(localizer, small, [0, 1], 12)
    process, models, screen = localizer.process, localizer.models, localizer.screen
    near = received(small.believed, run.observations[11])
    x, covariance, _ = predict(process, run.beliefs[11], run.observations[11])
    blocks = [m.linearize(process, x, run.observations[11], near) for m in models]
    e = torch.ones(process.error_size, dtype=torch.float64)
    weights = []
    for length in (1.0, 10.0):
        of_error = e.clone()
        of_error[:6] = length  # positions and velocities; angles are angles
        scaled = [
            replace(
                block,
                residual=length * block.residual,
                jacobian=length * block.jacobian / of_error,
                variance=length**2 * block.variance,
                partner_variance=None
                if block.partner_variance is None
                else length**2 * block.partner_variance,
            )
            for block in blocks
        ]
        wide = covariance * of_error * of_error.unsqueeze(-1)
        prior = Prediction(x, wide, run.observations[11], run.beliefs[11].memory)
        trusts = screen.weigh(scaled, screen.judge(scaled, prior), True)
        weights.append([trust.weight for trust in trusts])
    for one, other, block in zip(*weights, blocks, strict=True):
        torch.testing.assert_close(one[block.mask], other[block.mask], rtol=0, atol=1e-5)
    assert weights[0][0][blocks[0].mask].std() > 1e-3


def test_a_network_without_units_starts_as_one_with_them_judges() -> None:
    """Where the noise is what it is made for."""
    torch.manual_seed(0)
    absolute = TrustNetwork().requires_grad_(False)
    for parameter in absolute.parameters():
        parameter.copy_(0.3 * torch.randn(parameter.shape))
    relative = TrustNetwork.relative_to(absolute, 0.15, 0.2)
    assert relative.features[2:5] == ("relative_std", "relative_doubt", "relative_partner")
    seen = torch.randn(50, 15)
    for std, call in ((0.15, "trust_vectors"), (0.2, "trust_ranges")):
        shifted = seen.clone()
        shifted[:, 2] -= math.log(std)
        width = 12 if call == "trust_vectors" else 15
        one = getattr(absolute, call)(seen[:, :width])
        other = getattr(relative, call)(shifted[:, :width])
        torch.testing.assert_close(one, other)


# ---------------------------------------------------------------- what trust does


def test_full_trust_is_the_plain_filter(tools: SimpleNamespace) -> None:
    """Huber's weights before the last iteration move the point of linearization, and no more."""
    scenario = make_scenario("indoor-v0")
    plain = make("ekf:iterations=6", scenario)
    run = tools.play(plain, scenario, [0, 1], 30)
    for logit, tolerance in ((40.0, 0.02), (None, 0.2)):  # standard deviations of the estimate
        localizer: Any = make("ekf_trust:bank=false", scenario, weights="none", iterations=6)
        constant(localizer, logit, None if logit is None else -40.0)
        found = tools.replay(localizer, run.observations)
        for one, other in list(zip(found.estimates, run.estimates, strict=True))[10:]:
            std = other.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
            assert ((one.position - other.position) / std).abs().max() < tolerance
            spread = one.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
            assert (spread / std - 1).abs().max() < tolerance


def test_no_trust_is_the_motion_model(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    localizer: Any = make("ekf_trust:bank=false", scenario, weights="none")
    run = tools.play(localizer, scenario, [0, 1], 6)
    constant(localizer, -200.0, None)
    _, found = localizer.step(run.beliefs[5], run.observations[5])
    dead: Any = make("dead_reckoning", scenario)
    _, expected = dead.step(run.beliefs[5], run.observations[5])
    tools.assert_same(found, expected, 1e-9)


@pytest.mark.parametrize("bias", [-40.0, 0.0, 7.0])
def test_biases_are_taken_off_ranges(bias: float, tools: SimpleNamespace) -> None:
    """Ranges longer by what the networks always say change nothing."""
    scenario = make_scenario("indoor-v0")
    localizer: Any = make("ekf_trust:bank=false", scenario, weights="none", iterations=1)
    run = tools.play(localizer, scenario, [0, 1], 15)  # known well enough for a single iteration
    longer = 0.2 * torch.nn.functional.softplus(torch.tensor(bias - 4.0))
    seen, estimates = run.observations[14], []
    for logit, ranges in ((-40.0, seen["ranges"]), (bias, seen["ranges"] + longer)):
        constant(localizer, 2.0, logit)
        estimates.append(localizer.step(run.beliefs[14], tools.change(seen, ranges=ranges))[1])
    tools.assert_same(*estimates, 1e-6)
    if bias > 0:
        apart = localizer.step(run.beliefs[14], seen)[1].position - estimates[0].position
        assert apart.abs().max() > 1e-3


def test_trust_enters_every_particle_alike(tools: SimpleNamespace) -> None:
    """Weight 0 is as good as a mask, weight ½ twice the variance, and a shift a shorter range."""
    scenario = make_scenario("indoor-v0")
    localizer: Any = make("apf", scenario)
    run = tools.play(localizer, scenario, [0, 1], 6)
    belief, seen = run.beliefs[5], run.observations[5]
    near, centre = received(scenario.believed, seen), belief.particles[..., 0, :]
    models = localizer.models
    assert [type(m) for m in models] == [LandmarkVectors, UavRanges]

    def gain(observation: Observation, *trusts: Trust) -> Tensor:
        return log_likelihood(
            models,
            localizer.process,
            belief.particles[..., :100, :],
            centre,
            observation,
            near,
            trusts,
        )

    g = torch.Generator().manual_seed(0)
    kept = [torch.rand(seen[m].shape, generator=g).round() for m in ("landmark_mask", "range_mask")]
    masked = tools.change(
        seen,
        landmark_mask=seen["landmark_mask"] * kept[0],
        range_mask=seen["range_mask"] * kept[1],
    )
    torch.testing.assert_close(
        gain(seen, Trust(kept[0]), Trust(kept[1])),
        gain(masked, Trust(), Trust()),
        rtol=1e-5,
        atol=1e-3,
    )
    half = [Trust(torch.full_like(k, 0.5)) for k in kept]
    whole = gain(seen, Trust(), Trust())
    torch.testing.assert_close(gain(seen, *half), 0.5 * whole, rtol=1e-4, atol=1e-2)
    shift = torch.rand(seen["ranges"].shape, generator=g)
    shorter = tools.change(seen, ranges=seen["ranges"] - shift)
    torch.testing.assert_close(
        gain(seen, Trust(), Trust(None, shift)),
        gain(shorter, Trust(), Trust()),
        rtol=1e-5,
        atol=1e-3,
    )
    assert (gain(shorter, Trust(), Trust()) - whole).abs().max() > 1


# ---------------------------------------------------------------- symmetry


def test_the_order_of_landmarks_is_the_order_of_their_trust(
    monkeypatch: pytest.MonkeyPatch, tools: SimpleNamespace
) -> None:
    scenario = make_scenario("indoor-v0", false_matches=0.1, landmarks=12)
    localizer, seen = watched("ekf_trust:bank=false", scenario, monkeypatch)
    run = tools.play(localizer, scenario, [0, 1], 12)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))

    def moved(leaf: Tensor) -> Tensor:
        return leaf.unflatten(-1, (12, -1))[..., order, :].flatten(-2)

    now, belief = run.observations[11], run.beliefs[11].clone()
    one, links, rest = belief.memory.split([1, 12 * PER_LINK, 5 * PER_LINK + PER_LINK], -1)
    belief.memory = torch.cat((one, moved(links), rest), -1)
    names = ("landmarks", "landmark_mask", "landmark_map")
    after, estimate = localizer.step(
        belief, tools.change(now, **{name: moved(now[name]) for name in names})
    )
    blocks, trusts = seen[-1]
    _, expected = seen[-2]
    mask = blocks[LANDMARKS].mask
    torch.testing.assert_close(
        trusts[LANDMARKS].weight[mask],
        expected[LANDMARKS].weight[..., order][mask],
        rtol=0,
        atol=1e-5,
    )
    torch.testing.assert_close(trusts[RANGES].weight, expected[RANGES].weight, rtol=0, atol=1e-5)
    tools.assert_same(estimate, run.estimates[11], 1e-5)
    torch.testing.assert_close(
        after.memory[..., 1 : 1 + 12 * PER_LINK],
        moved(run.beliefs[12].memory[..., 1 : 1 + 12 * PER_LINK]),
        rtol=0,
        atol=1e-6,
    )
    assert (expected[LANDMARKS].weight[mask] < 0.5).any()  # or any order would have done


def test_a_link_remembers_itself_alone(tools: SimpleNamespace) -> None:
    """Other memories of one link change what becomes of that link's memory, and of no other's; nor
    of another UAV's. (What they change in an estimate is seen in later innovations only.)"""
    scenario = make_scenario("indoor-v0")
    localizer: Any = make("ekf_trust:bank=false", scenario)
    run = tools.play(localizer, scenario, [0, 1], 5)
    memory = run.beliefs[4].memory
    assert memory.shape[-1] == 1 + PER_LINK * (20 + 6)
    for link in (0, 7, 19, 20, 24):
        place = slice(1 + PER_LINK * link, 1 + PER_LINK * (link + 1))
        belief = run.beliefs[4].clone()
        belief.memory = memory.clone()
        belief.memory[:, 2, place] += 1.0
        after, estimate = localizer.step(belief, run.observations[4])
        apart = (after.memory - run.beliefs[5].memory).abs()
        assert (apart[:, 2, place] > 0.5).all()
        apart[:, 2, place] = 0
        assert not apart.any()
        others = [i for i in range(6) if i != 2]
        tools.assert_same(estimate[:, others], run.estimates[4][:, others])


def test_links_that_are_not_seen_keep_their_memory(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", landmark_radius=6.0)
    localizer: Any = make("ekf_trust:bank=false", scenario)
    run = tools.play(localizer, scenario, [0, 1], 8)
    links = [b.memory[..., 1 : 1 + 20 * PER_LINK].unflatten(-1, (20, -1)) for b in run.beliefs]
    for k, seen in enumerate(run.observations):
        unseen = seen["landmark_mask"] == 0
        assert unseen.any()
        assert torch.equal(links[k + 1][unseen], links[k][unseen])
        assert ((links[k + 1] != links[k]).any(-1) | unseen).all()
        times = torch.stack([o["landmark_mask"] for o in run.observations[: k + 1]]).sum(0)
        torch.testing.assert_close(links[k + 1][..., 2].float(), 1 - 0.9**times, rtol=0, atol=1e-6)


def test_uavs_that_say_nothing_change_nothing(
    monkeypatch: pytest.MonkeyPatch, tools: SimpleNamespace
) -> None:
    """Nine UAVs of which three were never heard estimate as six do."""
    six, nine = (make_scenario("indoor-v0", n_uavs=n, nlos=0.3) for n in (6, 9))
    run = tools.play(make("ekf_trust:bank=false", six), six, [0, 1], 10)
    widths = {"ranges": 1, "range_mask": 1, "messages": 9, "message_mask": 1, "links": 1}

    def larger(observation: Observation) -> Observation:
        leaves = {}
        for name, leaf in observation.leaves.items():
            if name in widths:
                leaf = torch.nn.functional.pad(leaf, (0, 3 * widths[name]))
            leaves[name] = torch.cat((leaf, leaf[:, :3]), 1)
        return Observation(leaves)

    wide = tools.replay(make("ekf_trust:bank=false", nine), [larger(o) for o in run.observations])
    for one, other in zip(wide.estimates, run.estimates, strict=True):
        tools.assert_same(one[:, :6], other, 1e-6)


# ---------------------------------------------------------------- the shipped weights


def first_seen(mask: Tensor, how_many: int) -> Tensor:
    """Numbers [B, N, k] of the first measurements that arrived."""
    return mask.float().sort(dim=-1, descending=True, stable=True).indices[..., :how_many]


@pytest.mark.parametrize("weights", ["trust", "trust_1"])
def test_a_false_match_is_not_trusted_and_honest_ones_are(
    weights: str, monkeypatch: pytest.MonkeyPatch, tools: SimpleNamespace
) -> None:
    """A landmark's vector is another one's. Over 15 worlds: at most 0.03 against 0.91 at least."""
    scenario = make_scenario("indoor-v0")
    localizer, seen = watched(f"ekf_trust:bank=false:weights={weights}", scenario, monkeypatch)
    run = tools.play(localizer, scenario, [0, 1, 2], 56)
    for k in (10, 30, 55):
        now = run.observations[k]
        mask = now["landmark_mask"] > 0
        assert (mask.sum(-1) >= 4).all()
        pair, vectors = first_seen(mask, 2), now["landmarks"].unflatten(-1, (-1, 3)).clone()
        planted, source = pair[..., :1], pair[..., 1:].unsqueeze(-1).expand(*pair.shape[:-1], 1, 3)
        vectors.scatter_(2, planted.unsqueeze(-1).expand_as(source), vectors.gather(2, source))
        localizer.step(run.beliefs[k], tools.change(now, landmarks=vectors.flatten(-2)))
        weight = seen[-1][1][LANDMARKS].weight
        assert weight.gather(-1, planted).max() < 0.2
        assert weight[mask.scatter(-1, planted, False)].min() > 0.8


@pytest.mark.parametrize("weights", ["trust", "trust_1"])
def test_a_range_that_went_around_is_not_trusted_and_honest_ones_are(
    weights: str, monkeypatch: pytest.MonkeyPatch, tools: SimpleNamespace
) -> None:
    """2 m too long: at most 0.04 over 15 worlds. Honest ranges beside it get 0.69 to 0.87 in the
    mean of 3 worlds, and as little as 0.12 where noise alone makes them 3 σ too long, which nothing
    tells from NLOS. The median without NLOS is 0.88 and 0.80 for the two trainings."""
    scenario = make_scenario("indoor-v0")
    localizer, seen = watched(f"ekf_trust:bank=false:weights={weights}", scenario, monkeypatch)
    run = tools.play(localizer, scenario, [0, 1, 2], 56)
    whole = torch.cat([trusts[RANGES].weight[blocks[RANGES].mask] for blocks, trusts in seen])
    assert whole.quantile(0.5) > 0.7
    for k in (10, 30, 55):
        now = run.observations[k]
        mask = now["range_mask"] > 0
        planted, ranges = first_seen(mask, 1), now["ranges"].clone()
        ranges.scatter_add_(-1, planted, torch.full(planted.shape, 2.0))
        localizer.step(run.beliefs[k], tools.change(now, ranges=ranges))
        weight = seen[-1][1][RANGES].weight
        assert weight.gather(-1, planted).max() < 0.2
        assert weight[mask.scatter(-1, planted, False)].mean() > 0.6


@pytest.mark.parametrize(
    ("name", "plain", "overrides", "share"),
    crossed(
        [("ekf_trust", "ekf"), ("pf_trust", "apf")],
        [({"nlos": 0.3}, 0.8), ({"false_matches": 0.1}, 0.3)],
        every=4,
    ),
    ids=str,
)
def test_trust_beats_none_in_every_world(
    name: str, plain: str, overrides: dict, share: float, tools: SimpleNamespace
) -> None:
    """Measured in 8 worlds, 2 trainings: 0.42 to 0.65 under NLOS, 0.05 to 0.11 else."""
    scenario = make_scenario("indoor-v0", **overrides)
    ours, theirs = (tools.score(n, scenario, 4, 60).rmse_per_run for n in (name, plain))
    assert (ours < share * theirs).all()
    assert (ours < 0.08).all()


# ---------------------------------------------------------------- options


@pytest.mark.parametrize("name", ["ekf_trust", "pf_trust"])
@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ({"robust": "huber"}, "robust is not allowed beside learned trust"),
        ({"weights": "trusty"}, "unknown checkpoint 'trusty'.*did you mean 'trust'"),
        ({"weights": "pfnn"}, "kind 'pfnn': 'trust' is needed"),
    ],
)
def test_options_that_cannot_be(name: str, chosen: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words) as error:
        make(name, make_scenario("indoor-v0"), **chosen)
    assert "\n" not in str(error.value)


def test_the_weights_are_never_trained_by_flying() -> None:
    localizer: Any = make("ekf_trust:bank=false", make_scenario("indoor-v0"))
    assert not any(p.requires_grad for p in localizer.screen.network.parameters())
