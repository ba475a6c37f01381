# %% [markdown]
# # Your own localizer
#
# A localizer is two pure functions over all UAVs of all worlds:
#
# - `reset(observation)` gives the belief before the first observation is used,
# - `step(belief, observation)` gives the next belief and the estimate.
#
# A belief is a tensorclass of batch (worlds, UAVs) that holds everything. Nothing is kept in the
# localizer itself, so that any row of a batch can be repeated alone.
#
# As an example: α–β tracking of the mean of the landmarks' fixes.

# %%
import torch
from tensordict import TensorClass
from torch import Tensor

from agents import LOCALIZERS, Estimate, Localizer
from coloc_env import make_scenario
from coloc_env.observation import Observation
from coloc_env.options import PositiveMetres, Share
from coloc_env.scenario import Believed
from coloc_env.sensors import Landmarks, Ranging
from training.evaluation.evaluate import evaluate

torch.set_num_threads(1)


class Track(TensorClass):
    """Position (m), velocity (m/s) and attitude (quaternion) of each UAV; batch (B, N)."""

    position: Tensor
    velocity: Tensor


# %% [markdown]
# Options are keyword-only parameters. Their types carry units and bounds, so that a wrong value is
# refused before anything runs. `serves` says which sensors the localizer uses, beside those that
# drive its motion model; a scenario that measures more is refused instead of ignored.


# %%
@LOCALIZERS.register("alpha_beta")
class AlphaBeta(Localizer):
    """α–β tracking of the ranges' and landmarks' prior: a first method of one's own."""

    name = "alpha_beta"
    serves = (Landmarks, Ranging)

    def __init__(
        self, believed: Believed, *, alpha: Share = 0.4, std: PositiveMetres = 0.5
    ) -> None:
        super().__init__(believed)
        self.alpha, self.std = alpha, std

    def reset(self, observation: Observation) -> Track:
        d = self.believed.arena.dim
        prior = observation["prior"]
        return Track(
            position=prior[..., :d].clone(),
            velocity=prior[..., d : 2 * d].clone(),
            batch_size=prior.shape[:2],
        )

    def step(self, belief: Track, observation: Observation) -> tuple[Track, Estimate]:
        d, dt = self.believed.arena.dim, self.believed.arena.dt
        predicted = belief.position + dt * belief.velocity
        # Landmarks are seen in the body frame; without an attitude only their distance is used:
        # move towards, or away from, each landmark by what its distance is off.
        seen = observation["landmarks"].unflatten(-1, (-1, d))
        mask = observation["landmark_mask"].unsqueeze(-1)
        places = observation["landmark_map"].unflatten(-1, (-1, d))
        apart = predicted.unsqueeze(-2) - places
        length = apart.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        off = (seen.norm(dim=-1, keepdim=True) - length) * apart / length * mask
        pull = 3 * off.sum(-2) / mask.sum(-2).clamp_min(1)
        position = predicted + self.alpha * pull
        velocity = belief.velocity + 0.1 * self.alpha / dt * pull
        after = Track(position=position, velocity=velocity, batch_size=belief.batch_size)
        covariance = self.std**2 * torch.eye(d).expand(*position.shape, -1)
        estimate = Estimate(
            position=position,
            velocity=velocity,
            covariance=covariance,
            batch_size=belief.batch_size,
        )
        return after, estimate


# %% [markdown]
# It is an agent now, for every function and for every environment.

# %%
scenario = make_scenario("indoor-v0", horizon=100)
found = evaluate(scenario, ["dead_reckoning", "alpha_beta", "alpha_beta:alpha=0.2", "ekf"], runs=3)
{
    name: round(figures["rmse_after_10s"] or figures["rmse"], 2)
    for name, figures in found.summary["agents"].items()
}

# %% [markdown]
# Put into a package with an entry point, it is found by the `coloc` command as well: see
# [Your own localizer, installed](../how-to/own-localizer.md).

# %%
LOCALIZERS.remove("alpha_beta")
