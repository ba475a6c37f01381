"""A run as pictures."""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from numpy.typing import NDArray

from agents.localizer import Localizer
from coloc_env.render import Renderer
from coloc_env.scenario import Scenario
from training.evaluation.rollout import rollout


def frames(
    localizer: Localizer,
    scenario: Scenario,
    seed: int,
    steps: int,
    every: int,
    progress: Callable[[int], None],
    device: str | torch.device = "cpu",
    scale: float = 1.0,
) -> Iterator[NDArray[np.uint8]]:
    """Pictures [H, W, 3] of a run's first ``steps`` steps, of every ``every``-th one;
    ``progress(steps_done)`` is called as steps are done. The localizer is on ``device``;
    pictures have ``scale`` times the renderer's own size."""
    renderer = Renderer(scenario, scale)
    for step in rollout(localizer, scenario, torch.tensor([seed]), steps, device=device):
        renderer.record(step.world, step.action)
        if (step.k + 1) % every == 0:
            picture = renderer.render(step.world, "rgb_array")
            assert picture is not None
            yield picture
        progress(step.k + 1)
    renderer.close()
