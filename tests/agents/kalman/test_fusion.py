"""Fusion of what UAVs have in common: the joint filter where it can be, and never fooled."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from agents import make
from agents.kalman.ekf import CooperativeEkf
from agents.kalman.pairwise import Pairwise, _offers
from coloc_env.scenarios import make_scenario


def pairwise(localizer: Any) -> Pairwise:
    assert isinstance(localizer, CooperativeEkf)
    assert isinstance(localizer.fusion, Pairwise)
    return localizer.fusion


# ---------------------------------------------------------------- exchange


@pytest.mark.parametrize("options", ["", ":robust=huber", ":robust=huber+gate"])
@pytest.mark.parametrize("overrides", [{}, {"range_bias_std": 0.3}], ids=str)
def test_whoever_has_every_measurement_has_the_joint_estimate(
    options: str, overrides: dict[str, float], tools: SimpleNamespace
) -> None:
    scenario = make_scenario("indoor-v0", landmarks=5, **overrides)
    run = tools.play(make(f"ekf_joint{options}", scenario), scenario, [0, 1], 12)
    alone = tools.replay(make(f"ekf:fusion=exchange{options}", scenario), run.observations)
    for one, other in zip(alone.estimates, run.estimates, strict=True):
        torch.testing.assert_close(one.position, other.position, rtol=0, atol=1e-6)
        torch.testing.assert_close(one.covariance, other.covariance, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("delay", [0, 2])
def test_what_comes_late_is_used_where_it_belongs(delay: int, tools: SimpleNamespace) -> None:
    """Ten steps in which half of all transmissions are lost, then none is: as soon as nothing is
    missing, estimates are the joint filter's."""
    scenario = make_scenario("indoor-v0", landmarks=5, message_delay=delay)
    run = tools.play(make("ekf_joint", scenario), scenario, [0, 1], 20)
    g = torch.Generator().manual_seed(0)
    seen = [
        tools.change(o, links=o["links"] * (torch.rand(o["links"].shape, generator=g) < 0.5))
        if k < 10
        else o
        for k, o in enumerate(run.observations)
    ]
    apart = tools.replay(make("ekf:fusion=exchange", scenario), seen)
    assert not apart.beliefs[-1].gone.any()
    assert (apart.position[8] - run.position[8]).abs().max() > 1e-4
    assert (apart.beliefs[8].lag > 0).any()
    assert (apart.beliefs[-1].lag == delay).all()
    if not delay:
        torch.testing.assert_close(apart.position[-1], run.position[-1], rtol=0, atol=1e-9)
    past = apart.beliefs[-1].team
    expected = run.beliefs[-1 - delay].state.unsqueeze(1).expand_as(past.state)
    torch.testing.assert_close(past.state, expected, rtol=0, atol=1e-9)


def test_a_uav_that_is_never_heard_is_left_out(tools: SimpleNamespace) -> None:
    """After the window nobody waits for it; the others are the joint filter of five."""
    scenario = make_scenario("indoor-v0", landmarks=5)
    run = tools.play(make("ekf_joint", scenario), scenario, [0], 16)
    seen = []
    for o in run.observations:
        links, mask = o["links"].clone(), o["range_mask"].clone()
        links[..., 5], mask[..., 5], mask[:, 5] = 0.0, 0.0, 0.0
        seen.append(tools.change(o, links=links, range_mask=mask))
    joint = tools.replay(make("ekf_joint", scenario), seen)
    apart = tools.replay(make("ekf:fusion=exchange", scenario), seen)
    gone = apart.beliefs[-1].gone[:, :5]
    assert gone[..., 5].all()
    assert not gone[..., :5].any()
    found, expected = (r.position[-1][:, :5] for r in (apart, joint))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)


def test_packets_have_the_size_of_what_was_measured(tools: SimpleNamespace) -> None:
    """IMU 24 bytes, a landmark 13, a range 5, and a bit for each of 6 · 12 packets."""
    scenario = make_scenario("indoor-v0", landmarks=5)
    localizer = make("ekf:fusion=exchange", scenario)
    run = tools.play(localizer, scenario, [0, 1], 5)
    seen = run.observations[-1]
    expected = 24 + 13 * seen["landmark_mask"].sum(-1) + 5 * seen["range_mask"].sum(-1) + 9
    sent = localizer.diagnostics(run.beliefs[-1])["bytes"]
    assert torch.equal(sent, expected.double())


# ---------------------------------------------------------------- pairwise


def test_two_uavs_that_meet_are_one_joint_filter(tools: SimpleNamespace) -> None:
    """Where nothing is far from linear, and without what pays for third parties."""
    scenario = make_scenario("indoor-v0", n_uavs=2, imu=False, landmarks=0, prior_std=0.05)
    localizer = make("ekf:fusion=pairwise", scenario)
    pairwise(localizer).kappa = 0.0
    run = tools.play(make("ekf_joint:iterations=4", scenario), scenario, [0, 1], 10)
    pair = tools.replay(localizer, run.observations)
    for one, other in zip(pair.estimates, run.estimates, strict=True):
        torch.testing.assert_close(one.position, other.position, rtol=0, atol=1e-4)
        torch.testing.assert_close(one.covariance, other.covariance, rtol=1e-3, atol=1e-7)
    expected = run.beliefs[-1].covariance.unflatten(-1, (2, -1))[:, 0, :, 1]
    factors = pairwise(localizer).factors(pair.beliefs[-1].shared)
    cross = factors[:, 0, 1] @ factors[:, 1, 0].mT
    torch.testing.assert_close(cross, expected, rtol=1e-3, atol=1e-6)
    assert cross.abs().max() > 1e-4


def smallest_eigenvalue(localizer: Any, belief: Any) -> float:
    """Of the correlation matrices of all pairs."""
    p, factors = belief.covariance, pairwise(localizer).factors(belief.shared)
    n, least = p.shape[1], torch.inf
    for i in range(n):
        for j in range(i):
            cross = factors[:, i, j] @ factors[:, j, i].mT
            both = torch.cat(
                (torch.cat((p[:, i], cross), -1), torch.cat((cross.mT, p[:, j]), -1)), -2
            )
            std = both.diagonal(dim1=-2, dim2=-1).sqrt()
            correlation = both / (std.unsqueeze(-1) * std.unsqueeze(-2))
            least = min(least, float(torch.linalg.eigvalsh(correlation).min()))
    return least


@pytest.mark.parametrize(
    ("steps", "overrides"),
    [
        (25, {"landmarks": 5}),
        (25, {"landmarks": 0, "message_loss": 0.5}),
        pytest.param(1000, {"landmarks": 5}, marks=pytest.mark.slow),
    ],
)
def test_every_pair_has_a_covariance(
    steps: int, overrides: dict[str, float], tools: SimpleNamespace
) -> None:
    scenario = make_scenario("indoor-v0", **overrides)
    localizer = make("ekf:fusion=pairwise", scenario)
    run = tools.play(localizer, scenario, [0], steps)
    assert all(smallest_eigenvalue(localizer, belief) > 0 for belief in run.beliefs[1:])


def team_eigenvalue(localizer: Any, belief: Any) -> float:
    """The smallest of the whole team's correlation matrices, of which each UAV holds its part."""
    p, factors = belief.covariance, pairwise(localizer).factors(belief.shared)
    n, e = p.shape[1], p.shape[-1]
    joint = (factors @ factors.transpose(1, 2).mT).transpose(2, 3).contiguous()  # Σ_ij
    own = torch.arange(n)
    joint[:, own, :, own] = p.movedim(1, 0)
    joint = joint.reshape(-1, n * e, n * e)
    std = joint.diagonal(dim1=1, dim2=2).sqrt()
    correlation = joint / (std.unsqueeze(-1) * std.unsqueeze(-2))
    return float(torch.linalg.eigvalsh(correlation).min())


@pytest.mark.parametrize(("partners", "kappa", "sound"), [(1, 3.0, True), (5, 0.0, False)])
def test_paying_for_third_parties_keeps_the_team_sound(
    partners: int, kappa: float, sound: bool, tools: SimpleNamespace
) -> None:
    """As printed, with everybody met in every step, it is not."""
    scenario = make_scenario("indoor-v0", landmarks=5)
    localizer = make(f"ekf:fusion=pairwise:partners={partners}", scenario)
    pairwise(localizer).kappa = kappa
    run = tools.play(localizer, scenario, [17], 25)
    least = min(team_eigenvalue(localizer, belief) for belief in run.beliefs[1:])
    assert least > 0 if sound else least < -0.3


def met(links: Tensor, step: int, tools: SimpleNamespace, partners: int = 1) -> Tensor:
    """How often everybody meets somebody in one step."""
    scenario = make_scenario("indoor-v0", landmarks=5)
    localizer = make(f"ekf:fusion=pairwise:partners={partners}", scenario)
    run = tools.play(localizer, scenario, [0], 1)
    seen = tools.change(run.observations[0], links=links.expand(1, 6, 6).float())
    belief = localizer.reset(seen)
    belief = belief.replace(step=torch.full_like(belief.step, step))
    return localizer.step(belief, seen)[0].shared[0, :, -1]


@pytest.mark.parametrize("partners", [1, 2])
def test_both_ends_of_a_link_or_neither(partners: int, tools: SimpleNamespace) -> None:
    everybody = 1 - torch.eye(6)
    assert (met(everybody, 3, tools, partners) == partners).all()
    assert (met(everybody.triu(), 3, tools, partners) == 0).all()
    only = torch.zeros(6, 6)
    only[1, 4] = only[4, 1] = 1.0
    only[2, 3] = 1.0
    for step in range(5):
        assert met(only, step, tools, partners).tolist() == [0, 1, 0, 0, 1, 0]


@pytest.mark.parametrize("n", [1, 2, 5, 6])
def test_a_round_robin_pairs_everybody_once(n: int) -> None:
    offers = _offers(n)
    pairs = [{frozenset((i, j)) for i, j in enumerate(turn) if i != j} for turn in offers]
    assert all(turn[turn[i]] == i for turn in offers for i in range(n))
    every = [pair for turn in pairs for pair in turn]
    assert len(every) == len(set(every)) == n * (n - 1) // 2


def test_late_messages_leave_a_uav_its_own_measurements(tools: SimpleNamespace) -> None:
    """Fused is what was four steps ago, as it would have been fused then; since, only one's own."""
    soon = make_scenario("indoor-v0", landmarks=5)
    late = make_scenario("indoor-v0", landmarks=5, message_delay=4)
    prompt = tools.play(make("ekf:fusion=pairwise", soon), soon, [0], 12)
    lately = tools.replay(make("ekf:fusion=pairwise", late), prompt.observations)
    past = lately.beliefs[-1].past
    torch.testing.assert_close(past.state, prompt.beliefs[-5].state, rtol=0, atol=1e-12)
    away = (lately.position[-1] - prompt.position[-1]).norm(dim=-1)
    assert 0 < away.mean() < 0.5
    spread, least = (
        r.estimates[-1].covariance.diagonal(dim1=-2, dim2=-1).sum() for r in (lately, prompt)
    )
    assert spread > least


# ---------------------------------------------------------------- consistency


@pytest.mark.slow
@pytest.mark.parametrize("fusion", ["ci", "pairwise", "exchange"])
def test_few_landmarks_leave_teams_honest(fusion: str, tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", landmarks=5)
    found = tools.score(f"ekf:fusion={fusion}", scenario, 6, 300)
    naive = tools.score("ekf", scenario, 6, 300)
    assert found.nees.mean() < 4.0 < naive.nees.mean()


# ---------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("ekf:partners=2", "partners is not allowed with fusion=naive"),
        ("ekf:fusion=ci:partners=2", "partners is not allowed with fusion=ci"),
        ("ekf:fusion=pairwise:partners=0", "partners='0'"),
        ("ekf:fusion=split", "naive, ci, pairwise, exchange"),
        ("ekf_trust:fusion=exchange", "exchange"),
    ],
)
def test_impossible_options_are_refused_in_one_line(name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as refused:
        make(name, make_scenario("indoor-v0"))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("fusion", ["pairwise", "exchange"])
def test_teams_with_few_slots_are_refused(fusion: str) -> None:
    with pytest.raises(ValueError, match="raise max_neighbours"):
        make(f"ekf:fusion={fusion}", make_scenario("indoor-v0", n_uavs=20))


def test_nothing_between_uavs_leaves_nothing_to_fuse(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", uwb=False)
    run = tools.play(make("ekf", scenario), scenario, [0], 3)
    for fusion in ("ci", "pairwise", "exchange"):
        other = tools.replay(make(f"ekf:fusion={fusion}", scenario), run.observations)
        torch.testing.assert_close(other.position, run.position, rtol=0, atol=1e-9)
