"""What walls, obstacles and the field of view leave of landmarks and ranges."""

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coloc_env import noise
from coloc_env.bounds import posterior_bound
from coloc_env.geometry import rotation_matrix
from coloc_env.motion import Arena, RandomCircles
from coloc_env.observation import action_width
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import RangeNoise, Sight
from coloc_env.sensors.base import Layout, Window
from coloc_env.world import World

PILLAR = (14.0, 9.0, 0.0, 16.0, 11.0, 5.0)
WALLS = (*PILLAR, 10.0, 0.0, 0.0, 10.2, 14.0, 5.0, 20.0, 6.0, 0.0, 20.2, 20.0, 5.0)
CLEAN: dict[str, Any] = {"uwb_std": 0.0, "wall_std": 0.0, "landmark_std": 0.0}


def episode(batch: int, steps: int, window: int | None = None, seed: int = 0, **overrides: Any):
    """Leaves [K, B, N, F] and true positions and attitudes [K, B, N, …]."""
    scenario = make_scenario("indoor-v0", **overrides)
    world = World(scenario, batch, window=window)
    seen, kept = world.reset(seed), []
    for _ in range(steps):
        truth = {"p": world.truth.position, "q": world.truth.attitude, "o": world.obstacles}
        kept.append({**seen.leaves, **truth})
        world.step(torch.zeros(batch, scenario.arena.n_uavs, action_width(scenario)))
        seen = world.observation()
    return {name: torch.stack([one[name] for one in kept]) for name in kept[0]}


def sampled(start, end, columns=None, radius=0.4):
    """How many walls and columns points between two places lie in."""
    share = torch.linspace(0, 1, 2001, dtype=torch.float64).unsqueeze(-1)
    points = start + share * (end - start)
    count = 0
    for i in range(0, len(WALLS), 6):
        low, high = (torch.tensor(WALLS[j : j + 3]) for j in (i, i + 3))
        count += bool(((points > low) & (points < high)).all(-1).any())
    for centre in () if columns is None else columns:
        count += bool(((points - centre)[:, :2].norm(dim=-1) < radius).any())
    return count


def test_landmarks_and_ranges_against_points_along_the_line() -> None:
    more = {"walls": WALLS, "obstacles": 5, "anchors": 4, "landmark_radius": 40.0}
    run = episode(1, 3, seed=4, **more, **CLEAN)
    for k in (0, 2):
        p, columns = run["p"][k, 0], run["o"][k, 0]
        landmarks = run["landmark_map"][k, 0, 0].view(-1, 3).double()
        anchors = run["anchor_map"][k, 0, 0].view(-1, 3).double()
        hidden = 0
        for i in range(6):
            for m, place in enumerate(landmarks):
                clear = sampled(p[i], place, columns) == 0
                assert clear == bool(run["landmark_mask"][k, 0, i, m])
                hidden += not clear
            for ends, leaf in ((p, "ranges"), (anchors, "anchor_ranges")):
                for m, place in enumerate(ends):
                    if leaf == "ranges" and m == i:
                        continue
                    walls = sampled(p[i], place, columns)
                    late = float(run[leaf][k, 0, i, m]) - float((p[i] - place).norm())
                    assert late == pytest.approx(0.3 * walls, abs=1e-4)
        assert 10 < hidden < 110
        ranges = run["ranges"][k, 0]
        assert torch.equal(ranges, ranges.mT)  # both ends


def test_noise_through_k_walls_adds_k_variances() -> None:
    many = 40_000
    keys = noise.fold(torch.zeros(many, dtype=torch.int64), torch.arange(many))
    sight = Sight(delay=0.3, std=0.2)
    for k in (1, 3):
        late = sight.lateness(torch.full((many,), k), keys, "ranging").double()
        assert float(late.mean()) == pytest.approx(0.3 * k, abs=5 * 0.35 / many**0.5)
        assert float(late.var()) == pytest.approx(0.04 * k, rel=0.05)
    assert not sight.lateness(torch.zeros(9, dtype=torch.int64), keys[:9], "ranging").any()


def test_nothing_passes_where_the_delay_is_infinite() -> None:
    run = episode(1, 2, walls=WALLS, anchors=4, wall_delay=math.inf, obstacles=3)
    p, columns = run["p"][1, 0], run["o"][1, 0]
    for i in range(6):
        for j in range(6):
            arrives = i != j and sampled(p[i], p[j], columns) == 0
            assert bool(run["range_mask"][1, 0, i, j]) == arrives
            assert bool(run["links"][1, 0, i, j]) == (i != j and sampled(p[i], p[j]) == 0)
    assert run["anchor_ranges"].isfinite().all()


def test_rows_windows_and_seeds() -> None:
    more = {"walls": WALLS, "obstacles": 3, "gust_std": 0.3, "uwb_outage": 0.4, "anchors": 3}
    more |= {"landmark_field": 2.0, "motion": "random", "uwb_outage_of": "team"}
    both = episode(2, 8, seed=6, **more)
    alone = episode(1, 8, window=5, seed=7, **more)
    for name, leaf in both.items():
        assert torch.equal(leaf[:, 1:], alone[name]), name
    assert not torch.equal(both["o"][:, 0], both["o"][:, 1])


def test_obstacles_move_slowly_enough_and_stay_in_the_room() -> None:
    sight, arena = Sight(obstacles=7, speed=1.2), Arena(3, 2, 0.1, (0.0,) * 3, (30.0, 20.0, 5.0))
    steps = torch.arange(600).expand(2, -1)
    places = sight.places(noise.row_keys(torch.arange(2)), steps, arena)[..., :2]
    assert places.shape == (2, 600, 7, 2)
    speed = (places[:, 1:] - places[:, :-1]).norm(dim=-1) / 0.1
    assert float(speed.max()) <= 1.2
    assert float(speed.mean()) > 0.1
    assert float(places.min()) >= 0.4
    assert bool((places <= torch.tensor((29.6, 19.6))).all())


@settings(max_examples=5, deadline=None)
@given(st.floats(0.1, 2 * math.pi), st.integers(0, 50))
def test_only_landmarks_in_the_cone_are_seen(field: float, seed: int) -> None:
    all_round, cone = (
        episode(1, 1, seed=seed, motion="aggressive", **extra)
        for extra in ({}, {"landmark_field": field})
    )
    apart = all_round["landmark_map"][0, 0, 0].view(-1, 3) - all_round["p"][0, 0].unsqueeze(1)
    ahead = rotation_matrix(all_round["q"][0, 0])[..., 0]
    angle = torch.acos(((apart @ ahead.unsqueeze(-1))[..., 0] / apart.norm(dim=-1)).clamp(-1, 1))
    within = all_round["landmark_mask"][0, 0] > 0
    sure = (angle - 0.5 * field).abs() > 1e-4
    seen = cone["landmark_mask"][0, 0] > 0
    assert bool((seen == (within & (angle <= 0.5 * field)))[sure].all())
    kept = seen.repeat_interleave(3, -1)  # what is seen is what it was
    assert torch.equal(cone["landmarks"][0, 0][kept], all_round["landmarks"][0, 0][kept])


def test_settings_at_which_nothing_is_in_the_way_change_nothing() -> None:
    plain = episode(2, 8, anchors=3)
    same = {"wall_delay": 9.0, "wall_std": 2.0, "obstacle_radius": 3.0, "obstacle_speed": 0.2}
    same |= {"gust_time": 4.0, "uwb_outage_time": 1.0, "uwb_outage_of": "team"}
    for name, leaf in episode(2, 8, anchors=3, landmark_field=2 * math.pi, **same).items():
        assert torch.equal(leaf, plain[name]), name


# ------------------------------------------------------------------------------------- outages


def outages(share: float, time: float, of: str, rows: int, steps: int, links: int, **more: Any):
    """[R, K, L]: which links are out."""
    arena = Arena(3, 2, 0.1, (0.0,) * 3, (1.0,) * 3)
    keys = noise.row_keys(torch.arange(rows))
    index = torch.arange(steps).expand(rows, -1)
    none: Any = None
    window = Window(Layout(arena, 2), none, none, keys, none, index, none, none, none)
    model = RangeNoise(outage=share, outage_time=time, outage_of=of, **more)
    return model.out(window, torch.arange(links), "ranging")


def test_outages_take_their_share_and_last() -> None:
    out = outages(0.4, 2.0, "link", 40, 400, 20).double()
    assert float(out.mean()) == pytest.approx(0.4, abs=0.02)
    centred = out - out.mean()
    for lag in (5, 20):
        kept = float((centred[:, lag:] * centred[:, :-lag]).mean() / centred.var())
        assert kept == pytest.approx(math.exp(-lag / 20), abs=0.04)
    assert float((out[:, 0, 0] - out[:, 0, 1]).abs().max()) == 1  # each for itself


def test_outages_of_a_team_take_all_ranges_at_once() -> None:
    out = outages(0.4, 2.0, "team", 30, 60, 5)
    assert bool((out == out[..., :1]).all())
    assert 0 < float(out.double().mean()) < 1
    outage = {"uwb_outage": 0.5, "uwb_outage_time": 0.5, "uwb_outage_of": "team"}
    run = episode(2, 30, n_uavs=3, anchors=3, **outage)
    between, anchors = run["range_mask"].sum((-1, -2)), run["anchor_range_mask"].sum((-1, -2))
    assert set(between.unique().tolist()) == {0.0, 6.0}
    assert torch.equal(between > 0, anchors > 0)


def test_ranges_can_be_off() -> None:
    out = outages(0.0, 2.0, "link", 2, 10, 3, off=(0.3, 0.5))
    assert out[0, :, 0].tolist() == [False] * 3 + [True] * 2 + [False] * 5
    assert RangeNoise().out(None, torch.arange(3), "ranging") is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"uwb_outage": 1.5}, "uwb_outage=1.5 is not allowed"),
        ({"uwb_outage_of": "room"}, "uwb_outage_of='room' is not allowed: one of link, team"),
        ({"uwb_off": (5.0, 1.0)}, r"off=\(5.0, 1.0\) is not allowed"),
        ({"landmark_field": 7.0}, "landmark_field=7.0 is not allowed"),
        ({"wall_delay": -0.1}, "wall_delay=-0.1 is not allowed"),
        ({"obstacles": -1}, "obstacles=-1 is not allowed"),
    ],
)
def test_what_makes_no_sense_is_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make_scenario("indoor-v0", **wrong)


# --------------------------------------------------------------------------- motion and bound


def test_random_circles_keep_clear_of_walls() -> None:
    walls = tuple((WALLS[i : i + 3], WALLS[i + 3 : i + 6]) for i in range(0, len(WALLS), 6))
    arena = Arena(3, 6, 0.1, (0.0,) * 3, (30.0, 20.0, 5.0))
    keys = noise.row_keys(torch.arange(20))
    steps = torch.arange(0, 1500, 2).expand(20, -1)

    def nearest(motion: RandomCircles) -> torch.Tensor:
        place = motion.advance(motion.start(keys, arena), steps, arena)[0].position[..., :2]
        found = []
        for low, high in walls:
            a, b = (place.new_tensor(side[:2]) for side in (low, high))
            found.append(torch.maximum(a - place, place - b).clamp_min(0.0).norm(dim=-1))
        return torch.stack(found).amin((0, 2))  # [R, N]

    assert float((nearest(RandomCircles()) < 0.3).double().mean()) > 0.3
    free = nearest(RandomCircles(walls=walls))
    assert float(free.min()) > 0.0
    assert float((free >= 0.3).double().mean()) > 0.95


def test_the_bound_counts_what_is_hidden_and_late() -> None:
    rest = {"landmarks": 0, "anchors": 4, "uwb": False, "n_uavs": 3}

    def rmse(**overrides: Any) -> float:
        return posterior_bound(make_scenario("indoor-v0", **overrides), 1, 0, 10).rmse

    assert rmse(**rest, walls=WALLS) > 1.02 * rmse(**rest)
    assert rmse(**rest, walls=WALLS, wall_std=0.0) == pytest.approx(rmse(**rest), rel=1e-9)
    alone = {"n_uavs": 2, "uwb": False}
    free = rmse(**alone)
    assert rmse(**alone, walls=WALLS) > 1.02 * free
    assert rmse(**alone, landmark_field=1.0) > 1.2 * free
