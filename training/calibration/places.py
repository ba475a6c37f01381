"""Anchors' places and tags' lever arms, refined where ranges and truth show better ones."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from coloc_env.datasets.noise_model import RangeModel
from coloc_env.datasets.recording import Floats, Recording
from coloc_env.datasets.residuals import Link, pose_at, tag_at, turned
from training.calibration.ranges import less_systematic

_PRIOR = 0.1  # m, by which a surveyed place may be off
_FEW = 30  # ranges that a place is refined by
_BETTER = 0.8  # of the error on ranges that were not used: what is not better is left alone
_HUBER = 0.2  # m


def refined_anchors(recording: Recording, model: RangeModel) -> dict[str, tuple[float, ...]]:
    """Anchors that are somewhere else than the map says."""
    links = less_systematic(recording, "anchor_ranges", model)
    found = {}
    for anchor, name in enumerate(recording.anchor_names):
        own = [link for link in links if link.other == anchor]
        if not own:
            continue
        ends = [tag_at(recording, link.robot, link.tags[:, 0], link.time) for link in own]
        tags = np.concatenate([place[known] for place, known in ends])
        ranges = np.concatenate(
            [k.measured[known] for k, (_, known) in zip(own, ends, strict=True)]
        )
        time = np.concatenate([k.time[known] for k, (_, known) in zip(own, ends, strict=True)])

        def off(place: Floats, tags: Floats = tags, ranges: Floats = ranges) -> Floats:
            return np.linalg.norm(tags - place, axis=1) - ranges

        place = _refined(off, recording.anchors[anchor], time)
        if place is not None:
            found[name] = tuple(place.tolist())
    return found


def refined_arms(
    recording: Recording, model: RangeModel
) -> dict[str, tuple[tuple[float, ...], ...]]:
    """Lever arms that are others than the recording says, of robots whose attitude is known."""
    if not recording.tags.shape[1]:
        return {}
    links = less_systematic(recording, "anchor_ranges", model)
    bare = replace(recording, tags=np.zeros_like(recording.tags))
    found = {}
    for robot, name in enumerate(recording.robots):
        arms = recording.tags[robot][~np.isnan(recording.tags[robot]).any(1)]
        own = [link for link in links if link.robot == robot]
        if not own or not arms.any():  # without an arm its attitude may be none
            continue
        better = [_arm(bare, own, tag, arm) for tag, arm in enumerate(arms)]
        if any(arm is not None for arm in better):
            chosen = [old if new is None else new for old, new in zip(arms, better, strict=True)]
            found[name] = tuple(tuple(arm.tolist()) for arm in chosen)
    return found


def _arm(bare: Recording, own: list[Link], tag: int, arm: Floats) -> Floats | None:
    mine = [(link, link.tags[:, 0] == tag) for link in own]
    time = np.concatenate([link.time[there] for link, there in mine])
    ranges = np.concatenate([link.measured[there] for link, there in mine])
    anchors = np.concatenate([np.tile(bare.anchors[k.other], (int(t.sum()), 1)) for k, t in mine])
    position, attitude, known = pose_at(bare.truth[own[0].robot], time)

    def off(place: Floats) -> Floats:
        tip = position + turned(attitude, np.tile(place, (len(position), 1)))
        return (np.linalg.norm(tip - anchors, axis=1) - ranges)[known]

    return _refined(off, arm, time[known])


def _refined(off: Callable[[Floats], Floats], place: Floats, time: np.ndarray) -> Floats | None:
    """A better place than the one given, if it also is on the half of the time that it was not
    fitted on."""
    if len(time) < _FEW:
        return None
    early = time < np.median(time)

    def fit(chosen: np.ndarray) -> Floats:
        def cost(x: Floats) -> Floats:
            return np.concatenate((off(x)[chosen], (x - place) * _HUBER / _PRIOR))

        found: Floats = least_squares(cost, place, loss="huber", f_scale=_HUBER).x
        return found

    def error(x: Floats, chosen: np.ndarray) -> float:
        return float(np.mean(np.minimum(np.abs(off(x)[chosen]), 3 * _HUBER)))

    for fitted, held in ((early, ~early), (~early, early)):
        if not error(fit(fitted), held) < _BETTER * error(place, held):
            return None
    return fit(np.ones(len(time), bool))
