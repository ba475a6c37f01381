"""SIR particle filters with Liu-West regularization and adaptive tempering, one per UAV.

Gordon, Salmond & Smith 1993; resampling when the effective sample size falls below half.
Neighbours enter as ranges whose variance is inflated by the sender's own uncertainty. Particles
live in padded tensors with a live count per UAV, fixed or adaptive (PF-NN paper, Algorithms 1, 2).
"""

from dataclasses import replace
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from agents.association import AssociationName, associated
from agents.association.clutter import reach_volume
from agents.errors import NotServed
from agents.localizer import Estimate
from agents.models.biases import reported
from agents.models.measurements import make_measurements, no_neighbours, received
from agents.models.process import make_process
from agents.particle import particle_count, sampling
from agents.particle.belief import ParticleBelief, Step, normal, own_keys
from agents.particle.cloud import Moments, moments
from agents.particle.printed import PERTURB_STD, PrintedResampling, anywhere
from agents.particle.resampling import FLOOR, Perturb, Resampling, padded, padded_weights
from agents.particle.update import CloudUpdate, Proposal, Renewal
from agents.robust import RobustScreen, Screen, Trust
from agents.robust.heavy_tails import mixture_log_density, student_log_density
from agents.tensorclasses import build
from coloc_env import noise
from coloc_env.observation import Observation
from coloc_env.options import Count, OpenShare, PositiveMetres, Quantity
from coloc_env.scenario import Believed
from coloc_env.sensors import UnlabelledLandmarks

Variant = Literal["regularized", "paper"]
Particles = Annotated[int, Quantity("", 10, 100_000)]
Pairing = Literal["mixture", "nearest", "joint"]
Likelihood = Literal["gaussian", "student", "mixture"]
_TAILS = {"gaussian": None, "student": student_log_density, "mixture": mixture_log_density}
_USUAL = ("liu_west", "ekf", "prior", "none")  # perturb, renewal, proposal, robust


class ParticleFilter(CloudUpdate):
    """Bootstrap filter; its number of particles is fixed unless ``bounds`` let it adapt.

    ``perturb``: ``liu_west`` moves resampled particles so that the cloud keeps its moments, above a
    small floor; ``fixed`` adds N(0, Σ_perturb) instead. A likelihood that leaves few particles is
    used in stages in the first steps; later (``renewal=ekf``), particles are redrawn from 1.1 ×
    an EKF's posterior about the cloud's moments, with exact weights (Kotecha & Djurić 2003) if
    enough survive those; ``renewal=none`` uses stages then, too; ``proposal=ekf`` redraws at every
    step. ``tempering=false`` uses every likelihood as it comes.
    ``variant=paper`` is the PF-NN paper's filter as printed instead of this ``regularized`` one:
    particles uniform in the arena at the start, plain weights (a neighbour counts as if its
    estimate were exact), resampling and counts as its Algorithms 1 and 2 have them,
    N(0, ``perturb_std``²) m added to positions, a tenth of it to velocities (m/s) and attitudes
    (rad), no tempering and no redraw.
    ``robust``, ``gate``: as ``ekf`` has them, decided by a Gaussian update at the cloud's moments.
    ``likelihood`` of each measurement: ``gaussian``, ``student``'s t with ν = 4, or a ``mixture``
    of two Gaussians. ``association`` of landmarks that come without names: for each particle a
    ``mixture``, in which a vector may be of any landmark, or clutter; or as ``ekf`` pairs them, at
    the cloud's moments.
    ``compile=true`` compiles the step's large parts at the first step (it takes up to a minute
    and needs a C++ compiler); the numbers then differ in their last digits.
    """

    name = "pf"

    def __init__(
        self,
        believed: Believed,
        *,
        particles: Particles,
        bounds: tuple[Particles, Particles] | None = None,
        seed: Count = 0,
        perturb: Perturb = "liu_west",
        tempering: bool = True,
        renewal: Renewal = "ekf",
        proposal: Proposal = "prior",
        robust: str = "none",
        gate: OpenShare = 0.999,
        cooperate: bool = True,
        compile: bool = False,
        variant: Variant = "regularized",
        perturb_std: PositiveMetres = PERTURB_STD,
        likelihood: Likelihood = "gaussian",
        association: Pairing = "mixture",
    ) -> None:
        super().__init__(believed)
        self.printed = variant == "paper"
        if self.printed and (perturb, renewal, proposal, robust) != _USUAL:
            raise ValueError("variant=paper takes no perturb, renewal, proposal or robust")
        if not self.printed and perturb_std != PERTURB_STD:
            raise ValueError("perturb_std is allowed with variant=paper only")
        if bounds is not None and not bounds[0] <= particles <= bounds[1]:
            raise ValueError(
                f"bounds={bounds} is not allowed: low,high with low ≤ particles ({particles}) "
                "≤ high"
            )
        self.particles, self.seed = particles, seed
        self.tempering, self.renewal = tempering and not self.printed, renewal
        self.bounds, self.proposal = bounds, proposal
        self.capacity = particles if bounds is None else bounds[1]
        self.process = make_process(believed)
        self.models = [m for m in make_measurements(believed) if cooperate or not m.cooperative]
        self.screen: Screen = RobustScreen(self.process, self.models, robust, gate)
        self.tails, self.heavy = _TAILS[likelihood], None
        if likelihood != "gaussian" and robust == "none":
            self.heavy = RobustScreen(self.process, self.models, likelihood, gate)
        method: AssociationName = "joint" if association == "mixture" else association
        self.association = associated(believed, self.process, method, gate)
        self.volume: float | None = None
        sensor = believed.sensor(UnlabelledLandmarks)
        if sensor is not None and association == "mixture":
            self.volume = reach_volume(sensor, believed.arena.dim)
            if robust != "none":
                raise NotServed(
                    "robust screens judge named landmarks: association=nearest or joint"
                )
        made = PrintedResampling(self.process, perturb_std, bounds) if self.printed else None
        self.resampling = made or Resampling.of(self.process, perturb, bounds)
        self.compiled = compile
        if compile:
            self._foresee = torch.compile(self._foresee, dynamic=False)  # type: ignore[method-assign]
            self.resampling.weigh = torch.compile(self.resampling.weigh, dynamic=False)  # type: ignore[method-assign]
            few = torch.compile(self.resampling.resample_few, dynamic=False)
            self.resampling.resample_few = few  # type: ignore[method-assign]

    @property
    def exchanges(self) -> bool:
        return self.screen.exchanges

    def reset(self, observation: Observation) -> ParticleBelief:
        if self.association is not None:
            observation = self.association.unseen(observation)
        prior = observation["prior"]
        mean, covariance = self.process.initial(prior)
        key = own_keys(observation, self.seed)
        m = self.capacity
        believed = anywhere(self.believed) if self.printed else self.believed
        particles = sampling.from_prior(self.process, believed, mean, covariance, key, m)
        count = torch.full_like(key, self.particles)
        live = particle_count.alive(count, m)
        if self.printed:
            mean = moments(self.process, particles, live / count.unsqueeze(-1)).mean
        return ParticleBelief(
            particles=torch.where(live.unsqueeze(-1), particles, mean.unsqueeze(-2)),
            log_weights=particle_count.equal_log_weights(live),
            count=count,
            key=key,
            step=torch.zeros_like(key),
            ess_share=torch.ones_like(prior[..., 0]),
            renewed=torch.zeros_like(key, dtype=torch.bool),
            last=mean[..., : 2 * self.process.dim],
            considered=self.biases.initial(observation, covariance.double()),
            memory=self.screen.memory(observation),
            conditional=covariance.new_zeros(*key.shape, 0, 0, dtype=torch.float64),
            batch_size=key.shape,
        )

    def step(
        self, belief: ParticleBelief, observation: Observation
    ) -> tuple[ParticleBelief, Estimate]:
        observation = observation if self.compiled else observation.kept()
        key, neighbours = (
            noise.fold(belief.key, belief.step),
            no_neighbours(belief.last[..., : self.process.dim]),
        )
        if any(model.cooperative for model in self.models):
            neighbours = received(self.believed, observation)
            if self.printed:
                neighbours = replace(neighbours, variance=torch.zeros_like(neighbours.variance))
        trusts = [Trust()] * len(self.models)
        now = Step(belief, observation, neighbours, trusts, key, self.association)
        found = self._updated(now)
        weighed = self.resampling.weigh(found.particles, found.log_weights, belief.count)
        particles, log_weights = self.resampling.next_particles(
            found.particles, weighed, belief.count, key
        )
        cloud = self.resampling.estimated(weighed, particles, log_weights)
        mean = cloud.mean
        after = build(
            ParticleBelief,
            key.shape,
            particles=padded(particles, mean, self.capacity),
            log_weights=padded_weights(log_weights, self.capacity),
            count=weighed.target,
            key=belief.key,
            step=belief.step + 1,
            ess_share=weighed.ess / belief.count,
            renewed=found.renewed,
            last=mean[..., : 2 * self.process.dim],
            considered=self._considered(now, found.density),
            memory=belief.memory if found.density is None else found.density.posterior.memory,
            conditional=found.conditional,
        )
        return after, self._estimate(cloud, after.considered)

    def mean(self, belief: ParticleBelief) -> Float32[Tensor, "B N S"]:
        return moments(self.process, belief.particles, belief.log_weights.exp()).mean

    def shifted(self, belief: ParticleBelief, offset: Float[Tensor, "B N d"]) -> ParticleBelief:
        return belief.shifted(offset)

    def restart_from(
        self,
        belief: ParticleBelief,
        rows: Bool[Tensor, "B N"],
        state: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
    ) -> ParticleBelief:
        key, like = noise.fold(belief.key, belief.step), belief.particles
        draws = normal(key, "pf.restart", self.process.error_size, self.capacity)
        drawn = sampling.gaussian(self.process, state, covariance, draws)
        state = state.to(like.dtype)
        count = torch.where(rows, self.particles, belief.count)
        live = particle_count.alive(count, self.capacity)
        drawn = torch.where(live.unsqueeze(-1), drawn, state.unsqueeze(-2))
        row = rows.unsqueeze(-1)
        return belief.replace(
            particles=torch.where(row.unsqueeze(-1), drawn, like),
            log_weights=torch.where(
                row, particle_count.equal_log_weights(live), belief.log_weights
            ),
            count=count,
            last=torch.where(row, state[..., : 2 * self.process.dim], belief.last),
            considered=torch.where(row.unsqueeze(-1), 0.0, belief.considered),
        )

    def diagnostics(self, belief: ParticleBelief) -> dict[str, Float[Tensor, "B N"]]:
        own = {
            "particles": belief.count.to(torch.float32),
            "ess_share": belief.ess_share,
            "renewed": belief.renewed.to(torch.float32),
        }
        if any(model.cooperative for model in self.models) and not self.screen.exchanges:
            message = 4.0 * 3 * self.process.dim
            own["bytes"] = torch.full_like(belief.ess_share, message)
        return own

    def _estimate(self, cloud: Moments, considered: Float[Tensor, "B N E G"]) -> Estimate:
        """The weighted cloud's mean, never surer of the position than the floor."""
        d, covariance = self.process.dim, reported(cloud.covariance, considered)
        least = torch.eye(d, dtype=torch.float64, device=covariance.device) * FLOOR["position"] ** 2
        return build(
            Estimate,
            cloud.mean.shape[:2],
            position=cloud.mean[..., :d],
            velocity=cloud.mean[..., d : 2 * d],
            covariance=covariance[..., :d, :d] + least,
        )


def refuse_biases(localizer: ParticleFilter) -> None:
    """Raise NotServed where sensors are believed to be biased, which a filter would ignore."""
    if localizer.biases:
        raise NotServed(
            "the biases that sensors are believed to have would be ignored: pf500 considers them"
        )
