"""Heavy-tailed likelihoods in filters that reweight: their updates find the most likely state."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.special import huber
from scipy.stats import chi2, multivariate_normal, multivariate_t

from agents import make
from coloc_env.scenarios import make_scenario

SIGMA = 0.15


def negative_log_likelihood(name: str, residuals: np.ndarray) -> float:
    """Of scaled residuals [M, 3], by SciPy."""
    if name == "student":
        return -float(multivariate_t(np.zeros(3), np.eye(3), df=4).logpdf(residuals).sum())
    if name == "mixture":
        narrow, wide = (multivariate_normal(np.zeros(3), c * np.eye(3)) for c in (1.0, 100.0))
        return -float(np.log(0.9 * narrow.pdf(residuals) + 0.1 * wide.pdf(residuals)).sum())
    core = np.sqrt(chi2(3).ppf(0.8214))
    return float(huber(core, np.linalg.norm(residuals, axis=1)).sum())


@pytest.mark.parametrize("name", ["huber", "student", "mixture"])
@pytest.mark.parametrize("agent", ["dfgo:exchange=none:window=2:iterations=20", "ukf"])
def test_an_update_finds_the_most_likely_state(
    agent: str, name: str, tools: SimpleNamespace
) -> None:
    """One step with wrong landmarks among those seen; prior, vectors and density given to SciPy."""
    overrides: dict[str, Any] = {"prior_std": 0.2, "prior_attitude_std": 1e-3, "n_uavs": 2}
    scenario = make_scenario("indoor-v0", false_matches=0.1, uwb=False, **overrides)
    localizer: Any = make(f"{agent}:robust={name}", scenario)
    if agent == "ukf":
        localizer.iterations = 20
    run, process = tools.play(localizer, scenario, [4], 1), localizer.process
    seen = run.observations[0]
    x, covariance = process.initial(seen["prior"].double())
    (model,) = localizer.models if agent == "ukf" else localizer.own
    z, mask = model.read(seen, 3)
    for uav in (0, 1):
        start, root = x[:, uav : uav + 1], np.linalg.cholesky(covariance[0, uav].numpy())
        places = seen["landmark_map"].double()[0, uav].view(-1, 3)

        def cost(scaled: np.ndarray, uav: int = uav, start: Any = start, root: Any = root,
                 places: Any = places) -> float:  # fmt: skip
            at = process.boxplus(start, torch.from_numpy(root @ scaled)[None, None])
            off = z[0, uav] - (places - at[0, 0, :3]) @ process.rotation(at)[0, 0]
            residuals = off[mask[0, uav]].numpy() / SIGMA
            return 0.5 * scaled @ scaled + negative_log_likelihood(name, residuals)

        estimate = run.estimates[0].position[0, uav].numpy()
        found = minimize(cost, np.zeros(9), method="BFGS", options={"gtol": 1e-6})
        best = process.boxplus(start, torch.from_numpy(root @ found.x)[None, None])[0, 0, :3]
        np.testing.assert_allclose(estimate, best, atol=2e-4)
