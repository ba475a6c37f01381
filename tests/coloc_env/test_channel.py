"""Links that are chosen, and broadcasts that collide: the rules one by one, and in the world."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from coloc_env import noise
from coloc_env.channel import Channel
from coloc_env.commands import SILENT, Commands
from coloc_env.motion import Arena, Roam
from coloc_env.network import Network
from coloc_env.scenario import DisplacementDriven, Prior, Scenario
from coloc_env.sensors import AnchorRanging, Displacement, RangeNoise, Ranging
from coloc_env.world import World

LINE = torch.tensor([[[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [200.0, 0.0], [210.0, 0.0]]]).double()
ANCHORS = ((0.0, 0.0), (100.0, 0.0))


def chosen(*calls: int, interference: float = 45.0) -> Channel:
    return Channel(torch.tensor([calls]), LINE, interference)


def pairs(matrix: Tensor) -> set[tuple[int, int]]:
    return {(i, j) for i, j in matrix[0].nonzero().tolist()}


@pytest.mark.parametrize(
    ("calls", "links"),
    [
        ((1, -1, -1, -1, -1), {(0, 1), (1, 0)}),
        ((1, 0, -1, -1, -1), set()),  # the target initiates
        ((1, -1, 1, -1, -1), set()),  # called twice
        ((1, -1, -1, 4, -1), {(0, 1), (1, 0), (3, 4), (4, 3)}),  # far apart
        ((3, -1, 4, -1, -1), {(0, 3), (3, 0), (2, 4), (4, 2)}),  # near its caller does not matter
        ((1, -1, 3, -1, -1), {(2, 3), (3, 2)}),  # another initiator near the target
        ((-1,) * 5, set()),
    ],
)
def test_exchanges_and_collisions(calls: tuple, links: set) -> None:
    assert pairs(chosen(*calls).chosen()) == links


def test_anchors_can_be_called_once_and_undisturbed() -> None:
    anchors = torch.tensor([[[0.0, 50.0], [205.0, 0.0]]]).double()
    assert pairs(chosen(5, -1, -1, -1, -1).to_anchors(anchors)) == {(0, 0)}
    assert pairs(chosen(5, 6, -1, -1, -1).to_anchors(anchors)) == {(0, 0), (1, 1)}
    assert pairs(chosen(5, 5, -1, -1, -1).to_anchors(anchors)) == set()
    assert pairs(chosen(6, -1, -1, 4, -1).to_anchors(anchors)) == set()


def test_who_listens_hears_the_only_one_that_speaks() -> None:
    reach = torch.ones(1, 5, 5, dtype=torch.bool)
    reach[0].fill_diagonal_(False)
    assert pairs(chosen(0, -1, -1, -1, -1).broadcast(reach)) == {(i, 0) for i in (1, 2, 3, 4)}
    assert pairs(chosen(0, -1, 0, -1, -1).broadcast(reach)) == set()
    reach[0, 3, 0] = False
    assert pairs(chosen(0, -1, 0, -1, -1).broadcast(reach)) == {(3, 2)}


def team(links: Any, horizon: int = 20) -> Scenario:
    sensors = (
        Displacement(0.1, 0.2),
        Ranging(RangeNoise(0.1, per_metre=0.01)),
        AnchorRanging(ANCHORS, RangeNoise(0.1), radius=60.0),
    )
    return Scenario(
        name="channel",
        arena=Arena(2, 6, 1.0, (0.0, 0.0), (100.0, 100.0)),
        horizon=horizon,
        motion=Roam(2.0),
        sensors=sensors,
        network=Network(radius=60.0, links=links),
        prior=Prior(1.0),
        process=DisplacementDriven(),
        believed_sensors=sensors,
    )


def calls_of(seeds: Tensor, k: Tensor) -> Tensor:
    keys = noise.fold(noise.row_keys(seeds), k)
    drawn = (noise.uniform(keys, "calls", 6) * 30).long()
    return torch.where(drawn < 8, drawn, SILENT)


@pytest.mark.parametrize("links", ["chosen", "broadcast"])
def test_rows_are_the_worlds_of_their_seeds_partial_resets_included(links: str) -> None:
    now = torch.tensor([4, 6, 8])
    world = World(team(links), 3)
    world.reset(now)
    records: list[dict[str, Tensor]] = []
    for k in range(10):
        if k == 4:
            rows = torch.tensor([True, False, False])
            now = torch.where(rows, 50, now)
            world.reset(now, rows)
        sent = {"sent": world.messages_sent, "bytes": world.bytes_sent}
        records.append(dict(world.observation().leaves) | sent)
        world.step(torch.randn(3, 6, 6), Commands(calls=calls_of(now, world.step_index)))
    assert any(record["range_mask"].any() for record in records)
    for row, seed, first in ((0, 50, 4), (1, 6, 0), (2, 8, 0)):
        alone = World(team(links))
        alone.reset([seed])
        for k in range(first, 10):
            sent = {"sent": alone.messages_sent, "bytes": alone.bytes_sent}
            for name, value in (dict(alone.observation().leaves) | sent).items():
                if name != "messages":
                    assert torch.equal(records[k][name][row], value[0]), (name, k)
            command = Commands(calls=calls_of(torch.tensor([seed]), alone.step_index))
            alone.step(torch.zeros(1, 6, 6), command)


def test_only_what_was_called_for_is_measured_and_counted() -> None:
    world = World(team("chosen"), 4)
    observation = world.reset(0)
    assert not observation["range_mask"].any()
    assert not observation["anchor_range_mask"].any()
    calls = torch.full((4, 6), SILENT)
    calls[:, 2], calls[0, 5] = 4, 6
    world.step(torch.zeros(4, 6, 6), Commands(calls=calls))
    observation = world.observation()
    links = {(i, j) for _, i, j in observation["range_mask"].nonzero().tolist()}
    assert links <= {(2, 4), (4, 2)}
    assert world.messages_sent[:, 2].tolist() == [1] * 4
    assert world.bytes_sent.sum() == (4 + 1) * 4 * 6
    world.step(torch.zeros(4, 6, 6))
    assert not world.observation()["range_mask"].any()
    with pytest.raises(ValueError, match="int64 of shape"):
        world.step(torch.zeros(4, 6, 6), Commands(calls=calls[:, :3]))


def test_targets_range_neither_anchors_nor_each_other() -> None:
    scenario = replace(team("all"), targets=2, network=Network())
    world = World(scenario, 3)
    observation = world.reset(1)
    mask = observation["range_mask"] > 0
    assert not mask[:, 4:, 4:].any()
    assert mask[:, :4, 4:].all()
    assert mask[:, 4:, :4].all()
    assert not observation["anchor_range_mask"][:, 4:].any()
    assert observation["anchor_range_mask"][:, :4].any()


def test_links_need_a_slot_for_everyone() -> None:
    with pytest.raises(ValueError, match=r"links='chosen' is not allowed"):
        replace(team("chosen"), network=Network(links="chosen", max_neighbours=3))
