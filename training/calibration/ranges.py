"""Ranges against truth: bias, deviation, tail and delay of every link."""

from dataclasses import replace

import numpy as np

from coloc_env.datasets.noise_model import LinkModel, RangeModel
from coloc_env.datasets.recording import Recording
from coloc_env.datasets.residuals import (
    Link,
    best_delay,
    has_truth,
    link_delay,
    links_of,
    true_ranges,
)
from training.calibration.noise import Noise, noise_of, pooled, shrunk

_FEW = 3  # ranges of a link that say anything


def calibrate_ranges(
    recording: Recording, stream: str
) -> tuple[RangeModel, dict[str, Noise]] | None:
    """The noise model of a stream of ranges and what is known of each link; None where there is
    nothing to learn from."""
    links = [link for link in links_of(recording, stream) if has_truth(recording, link)]
    common = best_delay(recording, links)
    delays = {link.name: link_delay(recording, link, common) for link in links}
    found = {}
    for link in links:
        distance, known = true_ranges(recording, link, delays[link.name])
        if known.sum() >= _FEW:
            found[link.name] = noise_of(link.time[known], (link.measured - distance)[known])
    if not found:
        return None
    parts = list(found.values())
    biases = dict(zip(found, shrunk(parts), strict=True))
    common_bias = float(np.median(list(biases.values())))
    links_model = {
        name: LinkModel(bias, delays[name])
        for name, bias in biases.items()
        if (bias, delays[name]) != (common_bias, common)
    }
    model = RangeModel(pooled(parts, "white"), common_bias, common, links_model)
    return model, found


def less_systematic(recording: Recording, stream: str, model: RangeModel) -> list[Link]:
    """A stream's links with ranges corrected and stamps moved to when they were measured."""
    found = []
    for link in links_of(recording, stream):
        own = model.of(link.name)
        time = link.time - round(own.delay * 1e9)
        found.append(replace(link, time=time, measured=link.measured - own.bias))
    return found
