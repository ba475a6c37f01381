"""Who hears whom, against brute force."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from torch import Tensor

from coloc_env import network as module
from coloc_env import noise
from coloc_env.motion import Box
from coloc_env.network import Network
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

BOX: Box = ((4.0, 4.0, 0.0), (6.0, 6.0, 3.0))


def ask(
    network: Network, position: np.ndarray, alive: np.ndarray | None = None
) -> tuple[Tensor, Tensor]:
    """Neighbours and reach [N, S] of one world at one step."""
    living = np.ones(len(position), bool) if alive is None else alive
    index, reach = network.neighbours(
        torch.from_numpy(position)[None, None], torch.from_numpy(living)[None, None]
    )
    return index.expand(reach.shape)[0, 0], reach[0, 0]


def heard(network: Network, position: np.ndarray, alive: np.ndarray | None = None) -> np.ndarray:
    """Matrix [N, N]: whether row hears column."""
    index, reach = ask(network, position, alive)
    matrix = np.zeros((len(position),) * 2, int)
    for i, (others, reached) in enumerate(zip(index, reach, strict=True)):
        for j in others[reached].tolist():
            matrix[i, j] += 1
    return matrix


def teams(n: int) -> st.SearchStrategy[np.ndarray]:
    coordinate = st.floats(0.0, 10.0, allow_nan=False, width=32)
    return hnp.arrays(np.float64, (n, 3), elements=coordinate)


@given(position=teams(5), alive=hnp.arrays(bool, 5), radius=st.floats(0.5, 12.0))
@settings(max_examples=15, deadline=None)
def test_a_dense_team_hears_all_within_the_radius(
    position: np.ndarray, alive: np.ndarray, radius: float
) -> None:
    apart = np.linalg.norm(position[:, None] - position[None], axis=-1)
    sure = np.abs(apart - radius) > 1e-6  # the boundary itself may round either way
    expected = (apart <= radius) & alive[:, None] & alive[None] & ~np.eye(5, dtype=bool)
    got = heard(Network(radius=radius), position, alive)
    assert (got == expected)[sure].all()
    everybody = heard(Network(), position, alive)
    assert (everybody == (alive[:, None] & alive[None] & ~np.eye(5, dtype=bool))).all()


@given(position=teams(9), alive=hnp.arrays(bool, 9), radius=st.none() | st.floats(1.0, 12.0))
@settings(max_examples=15, deadline=None)
def test_a_large_team_hears_its_nearest(
    position: np.ndarray, alive: np.ndarray, radius: float | None
) -> None:
    network = Network(radius=radius, max_neighbours=3)
    index, reach = ask(network, position, alive)
    assert index.shape == (9, 3)
    apart = np.linalg.norm(position[:, None] - position[None], axis=-1)
    limit = math.inf if radius is None else radius
    for i in range(9):
        others = [j for j in range(9) if j != i and alive[i] and alive[j]]
        within = [j for j in others if apart[i, j] <= limit - 1e-5]
        chosen = index[i][reach[i]].tolist()
        assert len(set(chosen)) == len(chosen)
        assert set(chosen) <= {j for j in others if apart[i, j] <= limit + 1e-5}
        assert len(chosen) >= min(3, len(within))
        # None left out is closer than one that was taken.
        rest = [apart[i, j] for j in within if j not in chosen]
        taken = [apart[i, j] for j in chosen]
        assert taken == sorted(taken) or np.allclose(taken, sorted(taken), atol=1e-5)
        assert not rest or not taken or max(taken) <= min(rest) + 1e-5


def test_nearest_neighbours_do_not_depend_on_blocks_or_far_away_origins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    generator = torch.Generator().manual_seed(0)
    position = 20 * torch.rand(3, 7, 30, 3, generator=generator, dtype=torch.float64)
    alive = torch.rand(3, 7, 30, generator=generator) > 0.1
    network = Network(radius=9.0, max_neighbours=5)
    index, reach = network.neighbours(position, alive)
    far_index, far_reach = network.neighbours(position + 1_000_000.0, alive)
    assert torch.equal(far_reach, reach)
    assert torch.equal(far_index[reach], index[reach])
    monkeypatch.setattr(module, "_BLOCK", 1)
    again_index, again_reach = network.neighbours(position, alive)
    assert torch.equal(again_index, index)
    assert torch.equal(again_reach, reach)


def blocked_by_sampling(start: np.ndarray, end: np.ndarray, box: Box) -> tuple[bool, bool]:
    """Whether points of a segment lie in a box: clearly inside, and inside or near."""
    points = start + np.linspace(0, 1, 2001)[:, None] * (end - start)
    depth = np.minimum(points - np.array(box[0]), np.array(box[1]) - points).min(-1).max()
    return bool(depth > 1e-9), bool(depth > -1e-2)


@given(position=teams(4))
@settings(max_examples=15, deadline=None)
def test_walls_block_the_line_of_sight(position: np.ndarray) -> None:
    for network in (Network(walls=(BOX,)), Network(walls=(BOX,), max_neighbours=3)):
        got = heard(network, position)
        assert (got == got.T).all()
        for i in range(4):
            for j in range(4):
                inside, near = blocked_by_sampling(position[i], position[j], BOX)
                if i != j and inside == near:
                    assert got[i, j] == (not inside), (i, j)


def test_walls_by_hand() -> None:
    position = np.array([[1, 5, 1], [9, 5, 1], [9, 5, 4], [5, 1, 1], [1, 5, 4]], float)
    got = heard(Network(walls=(BOX,)), position)
    assert got[0, 1] == 0  # through the box
    assert got[0, 2] == 0  # rising, but still through it
    assert got[4, 2] == 1  # above it
    assert got[0, 3] == 1  # past its corner
    two = heard(Network(walls=(BOX, ((0.0, 2.0, 0.0), (10.0, 3.0, 5.0)))), position)
    assert two[0, 3] == 0  # the second wall stands between them
    assert two[4, 2] == 1


def test_walls_block_ranges_messages_and_links() -> None:
    """Two UAVs on opposite sides of a circle about a pillar never hear each other."""
    pillar = (14.0, 9.0, 0.0, 16.0, 11.0, 5.0)
    world = World(make_scenario("indoor-v0", n_uavs=4, walls=pillar, wall_delay=math.inf), 1)
    observation = world.reset(0)
    for k in range(30):
        for name in ("links", "range_mask") + (("message_mask",) if k else ()):
            mask = observation[name][0]
            for i in range(4):
                assert mask[i, (i + 2) % 4] == 0
                assert mask[i, (i + 1) % 4] == 1
        world.step(torch.ones(1, 4, 9))
        observation = world.observation()


def test_loss_falls_on_each_direction_and_step_by_itself() -> None:
    world = World(make_scenario("indoor-v0", message_loss=0.3), 20)
    world.reset(0)
    links = []
    for _ in range(100):
        observation = world.observation()
        links.append(observation["links"].double())
        assert (observation["range_mask"].sum(-1) == 5).all()  # ranging is not messaging
        world.advance(torch.zeros(20, 6, 9))
    x = torch.stack(links)  # [100, 20, 6, 6]
    off = ~torch.eye(6, dtype=torch.bool)
    assert (x[..., ~off] == 0).all()
    got = x[..., off]
    n = got.numel()
    assert abs(float(got.mean()) - 0.7) < 5 * math.sqrt(0.21 / n)
    both = (x * x.transpose(-1, -2))[..., off]
    assert abs(float(both.mean()) - 0.49) < 5 * math.sqrt(0.5 / n)
    twice = (x[1:] * x[:-1])[..., off]
    assert abs(float(twice.mean()) - 0.49) < 5 * math.sqrt(0.5 / n)


@pytest.mark.parametrize("network", [Network(failure=0.3), Network(4.0, (), 0.0, 0, 5, 0.3)])
def test_broken_links_carry_nothing_either_way(network: Network) -> None:
    """A share of all links in each step, drawn again."""
    n = 6 if network.dense(6) else 24
    whole = World(
        replace(make_scenario("indoor-v0", n_uavs=n), network=replace(network, failure=0.0)), 20
    )
    broken = World(replace(whole.scenario, network=network), 20)
    ideal, seen = whole.reset(0), broken.reset(0)
    idle, pairs = torch.zeros(20, n, 9), []
    for k in range(40):
        for name in ("links", *(["message_mask"] if k else [])):
            assert torch.equal(seen[name], seen["range_mask"]), name
        assert (seen["links"] <= ideal["links"]).all()
        matrix = torch.zeros(2, 20, n, n)
        for link, world in zip(matrix, (ideal, seen), strict=True):
            senders = torch.arange(n).expand(20, n, n)
            if "neighbours" in ideal:
                senders = ideal["neighbours"].long()
            link.scatter_add_(2, senders, world["links"])
        there, left = (link > 0 for link in matrix)
        both = there & there.mT
        assert torch.equal((left & both), (left & both).mT)
        pairs.append(torch.where(both.triu(), left, torch.nan).double())
        whole.advance(idle)
        broken.advance(idle)
        ideal, seen = whole.observation(), broken.observation()
    x = torch.stack(pairs)
    count = int(x.isfinite().sum())
    assert abs(float(x.nanmean()) - 0.7) < 5 * math.sqrt(0.21 / count)
    twice = (x[1:] * x[:-1]).nanmean()
    assert abs(float(twice) - 0.49) < 5 * math.sqrt(0.5 / count)


@pytest.mark.parametrize("overrides", [{}, {"n_uavs": 24, "comm_radius": 4.0}])
def test_lost_messages_are_neither_seen_nor_masked_in(overrides: dict[str, Any]) -> None:
    world = World(make_scenario("indoor-v0", message_loss=0.4, **overrides), 3)
    world.reset(0)
    n = world.scenario.arena.n_uavs
    for k in range(6):
        action = (1.0 + torch.arange(float(n)) + 100 * k)[None, :, None].expand(3, n, 9)
        world.step(action)
        observation = world.observation()
        assert torch.equal(observation["message_mask"], observation["links"])
        content = observation["messages"].unflatten(-1, (-1, 9))
        senders = torch.arange(float(n)).expand(3, n, n)
        if "neighbours" in observation:
            senders = observation["neighbours"]
        expected = (1.0 + senders + 100 * k) * observation["links"]
        assert torch.equal(content, expected.unsqueeze(-1).expand_as(content))


def test_slots_beyond_reach_name_nobody() -> None:
    world = World(make_scenario("indoor-v0", n_uavs=20, comm_radius=0.8), 2)
    observation = world.reset(0)
    empty = observation["range_mask"] == 0
    assert empty.any()
    assert (observation["neighbours"][empty] == 0).all()
    assert (observation["ranges"][empty] == 0).all()


def test_loss_depends_on_the_pair_not_on_the_slot() -> None:
    keys = noise.row_keys(torch.arange(1)).unsqueeze(-1)
    network = Network(loss=0.5)
    reach = torch.ones(1, 1, 4, 4, dtype=torch.bool)
    index = torch.arange(4).expand(1, 1, 4, 4)
    straight = network.delivered(keys, index, reach)
    assert torch.equal(network.delivered(keys, index.flip(-1), reach).flip(-1), straight)


def test_a_team_of_two_slots_is_dense_up_to_its_size() -> None:
    scenario = make_scenario("indoor-v0", n_uavs=5, max_neighbours=5)
    assert "neighbours" not in World(scenario, 1).reset(0)
    sparse = replace(scenario, network=Network(max_neighbours=4))
    observation = World(sparse, 1).reset(0)
    assert observation["neighbours"].shape == (1, 5, 4)
    assert observation["links"].sum() == 20


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"radius": 0.0}, "radius=0.0 is not allowed: a distance in m > 0"),
        ({"loss": 2.0}, "loss=2.0 is not allowed: a probability"),
        ({"failure": -0.5}, "failure=-0.5 is not allowed: a probability"),
        ({"delay": -1}, "delay=-1 is not allowed: a number of steps"),
        ({"max_neighbours": 0}, "max_neighbours=0 is not allowed: at least one slot"),
    ],
)
def test_settings_are_checked(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Network(**wrong)
