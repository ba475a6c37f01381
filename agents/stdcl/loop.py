"""ST-DCL: the DW-MDS optimizer and the ST-GNN in a closed loop (paper, sections 4 and 4.2.3)."""

import math
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float64
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate, Localizer
from agents.stdcl.features import Memory, Scene, forgotten, look
from agents.stdcl.network import Correction, Past, StGnn
from agents.swarm import joint
from agents.swarm.among_anchors import is_plain
from agents.swarm.belief import Found, Prepared, SwarmBelief
from agents.swarm.filter import SwarmFilter
from agents.swarm.links import along_links, lengths
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.sensors import PositionFix, Ranging

Feedback = Literal["none", "paper", "links", "positions", "learned"]
_LINKS: tuple[Feedback, ...] = ("paper", "links", "learned")
_POSITIONS: tuple[Feedback, ...] = ("positions", "learned")
_RATE = math.log(1.1)  # largest change of a link's confidence in a step, as a logarithm
_LEAST = 0.1  # confidence of a link
REACH = 3.0  # standard deviations
_GAIN = 0.05  # κ of the paper's feedback
_PACE = 1.0  # s between steps in training


class LoopBelief(TensorClass):
    """The optimizer's belief, what the network remembers, and the confidence that it has fed back
    for each link; batch (B, N)."""

    base: SwarmBelief
    memory: Memory
    past: Past
    confidence: Float64[Tensor, "B N N"]


class NetworkLoop(Localizer[LoopBelief]):
    """A swarm filter whose positions a graph network corrects, and what is fed back to it.

    ``feedback``: ``positions``, the next step starts from the corrected positions and the variance
    that the network gives them; ``links``, the weight of each link is held down as far as the
    network says; ``learned``, both; ``paper``, links are held down by equation 36; ``none``.
    A link's confidence changes by a tenth a step at most, and is a tenth at least.

    Where gradients are asked for, what is fed back is followed to the next position in first order,
    neighbours held: ∂y/∂m = λ H⁻¹, ∂y/∂c_ij = H⁻¹ W_ij (d̃_ij − ‖y_i − y_j‖) u_ij / c_ij.
    """

    centralized = True
    serves = (Ranging, PositionFix)

    def __init__(self, base: SwarmFilter, network: StGnn, feedback: Feedback) -> None:
        super().__init__(base.believed)
        if not is_plain(base.believed):
            raise ValueError(
                "a team is needed whose motion an INS drives, with ranges between centres"
            )
        self.base, self.feedback = base, feedback
        self.rate = min(1.0, base.believed.arena.dt / _PACE)
        self.network = network.double().requires_grad_(False)

    def learn(self, network: StGnn) -> None:
        """Correct by this network from now on."""
        self.network = network

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> LoopBelief:
        base, d = self.base.reset(observation), self.base.process.dim
        shape = base.batch_size
        return build(
            LoopBelief,
            shape,
            base=base,
            memory=forgotten(shape[0], shape[1], d, base.step.device),
            past=self.network.start(shape, d),
            confidence=base.variance.new_ones(*shape, shape[1]),
        )

    def step(self, belief: LoopBelief, observation: Observation) -> tuple[LoopBelief, Estimate]:
        with torch.no_grad():
            now = self.base.prepared(belief.base, observation)
            if self.feedback in _LINKS:
                now = replace(now, confidence=belief.confidence)
            found = self.base.find(belief.base, now)
            weight, shift = self.base.weigh(found.position, now)
            reach = self._reach(now, found)
            scene, memory = look(now, found, weight, shift, self.base.std, belief.memory, reach)
        correction, past = self.network(scene, belief.past)
        if torch.is_grad_enabled():
            found = replace(found, position=found.position + _owed(belief, now, scene, shift))
        best = _corrected(now, found, correction, self.rate)
        goes_on = best if self.feedback in _POSITIONS else found
        after = build(
            LoopBelief,
            belief.batch_size,
            base=self.base.concluded(belief.base, now, goes_on),
            memory=memory,
            past=past,
            confidence=self._fed_back(belief.confidence, now, best, correction),
        )
        return after, self.base.estimated(now, best)

    def diagnostics(self, belief: LoopBelief) -> dict[str, Float64[Tensor, "B N"]]:
        return self.base.diagnostics(belief.base)

    def _reach(self, now: Prepared, found: Found) -> Float64[Tensor, "B N"]:
        """The largest correction (m): three standard deviations of a position, or of what a step's
        links have told of it if that is less. So who hears nobody is not moved."""
        told = (now.variance - found.variance).clamp_min(0.0)
        return REACH * torch.minimum(found.variance, told).sqrt()

    def _fed_back(
        self, old: Float64[Tensor, "B N N"], now: Prepared, best: Found, correction: Correction
    ) -> Float64[Tensor, "B N N"]:
        """The links' confidence after a step; that of links that were not there stays."""
        if self.feedback not in _LINKS:
            return old
        wanted = correction.confidence.double()
        if self.feedback == "paper":
            off = (now.links.distance - lengths(best.position)).abs() / self.base.std
            wanted = torch.exp(-_GAIN * off)
        change = (wanted.clamp_min(_LEAST) / old).log()
        return torch.where(now.links.mask, old * torch.exp(_RATE * torch.tanh(change / _RATE)), old)


def _owed(
    belief: LoopBelief, now: Prepared, scene: Scene, shift: Float64[Tensor, "B N N"]
) -> Float64[Tensor, "B N d"]:
    """Zeros whose gradient is that of the position found by what had been fed back."""
    start = belief.base.state[..., : scene.position.shape[-1]]
    push = scene.trust.unsqueeze(-1) * (start - start.detach())
    before = belief.confidence
    change = before / before.detach() - 1
    pull = change * scene.weight * (now.links.distance - scene.length - shift)
    push = push + along_links(scene.position, pull, scene.length)
    return torch.where(scene.moves.unsqueeze(-1), (scene.gain @ push.unsqueeze(-1))[..., 0], 0.0)


def _corrected(now: Prepared, found: Found, correction: Correction, rate: float) -> Found:
    """p̂ = p + γ Δp (eq. 34) and its variance, dead reckoning's at most; who is fixed stays. What
    the network says of variances multiplies from step to step: steps that are ``rate`` times as
    long as in training take that power of it."""
    moves = ~now.fixed
    position = found.position + correction.offset.double()
    variance = torch.minimum(found.variance * correction.spread.double() ** rate, now.variance)
    variance = torch.where(moves, variance, found.variance)
    return Found(
        torch.where(moves.unsqueeze(-1), position, found.position),
        variance,
        None if found.joint is None else joint.scaled(found.joint, variance),
    )
