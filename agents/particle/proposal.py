"""A Gaussian importance density: an EKF's posterior about the moments of a predicted cloud."""

from dataclasses import dataclass

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from agents.models.process import Process
from agents.models.update import Update, iterated_update
from agents.particle import particle_count
from agents.particle.belief import Step, normal
from agents.particle.cloud import moments, normalized
from agents.particle.sampling import gaussian
from agents.robust import Prediction, Screen

_WIDEN = 1.1  # of the posterior's covariance that is drawn from
_ITERATIONS = 3  # of the update that screens measurements and makes the density


@dataclass(frozen=True)
class ImportanceDensity:
    """A Gaussian prior at a predicted cloud's moments, and its update by the measurements."""

    prior: Prediction
    posterior: Update


def importance_density(
    screen: Screen,
    floor: Float64[Tensor, "E"],
    particles: Float32[Tensor, "B N M S"],
    log_weights: Float32[Tensor, "B N M"],
    now: Step,
) -> ImportanceDensity:
    """A Gaussian update at the moments of the predicted cloud, its covariance above a ``floor`` of
    standard deviations; measurements are weighted by the screen."""
    process = screen.process
    cloud = moments(process, particles, log_weights.exp())
    covariance = cloud.covariance + torch.diag(floor.to(cloud.covariance.device) ** 2)
    prior = Prediction(cloud.mean.double(), covariance, now.observation, now.belief.memory)
    if now.association is not None:
        prior = now.association.named(prior)
    return ImportanceDensity(prior, iterated_update(prior, now.neighbours, screen, _ITERATIONS))


def draw(
    process: Process, density: ImportanceDensity, now: Step, slots: int
) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
    """Particles x ~ N(x̂⁺, 1.1 P⁺) of the density's posterior, with the log-weights that make them
    stand for its prior (Kotecha & Djurić 2003):

    log w = log N(x; x̂⁻, P⁻) − log N(x; x̂⁺, 1.1 P⁺) = ½ (‖ε‖² − ‖L⁻¹ (x ⊟ x̂⁻)‖²) + const,

    where x = x̂⁺ ⊞ √(1.1 P⁺) ε and P⁻ = L Lᵀ.
    """
    draws = normal(now.key, "pf.propose", process.error_size, slots)
    particles = gaussian(
        process, density.posterior.state, _WIDEN * density.posterior.covariance, draws
    )
    mean = density.prior.state.to(draws.dtype).unsqueeze(-2)
    away = process.boxminus(particles, mean).double()
    root = torch.linalg.cholesky_ex(density.prior.covariance).L
    scaled = torch.linalg.solve_triangular(root, away.mT, upper=False)
    ratio = 0.5 * (draws.double().square().sum(-1) - scaled.square().sum(-2))
    live = particle_count.alive(now.belief.count, slots)
    return particles, normalized(torch.where(live, ratio, -torch.inf).to(draws.dtype))
