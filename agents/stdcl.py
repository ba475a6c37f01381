"""ST-DCL: the DW-MDS optimizer and the ST-GNN in a closed loop (paper, Figure 1)."""

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float64
from tensordict import TensorClass
from torch import Tensor

from agents.checkpoint import learned
from agents.dwmds import DynamicMds
from agents.localizer import Estimate, Localizer, register
from agents.stgnn.features import Memory, Scene, forgotten, look
from agents.stgnn.network import Correction, Past, StGnn
from agents.swarm.filter import Confidence, Found, Prepared, SwarmBelief
from agents.swarm.links import lengths
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.scenario import Believed

Feedback = Literal["none", "paper", "links", "positions", "learned"]
_RATE = 0.1  # largest change of a link's confidence in a step, as a share
_LEAST = 0.1  # confidence of a link


class LoopBelief(TensorClass):
    """The optimizer's belief, what the network remembers, and the confidence that it has fed back
    for each link; batch (B, N)."""

    base: SwarmBelief
    memory: Memory
    past: Past
    confidence: Float64[Tensor, "B N N"]


@register("stdcl")
class StDcl(Localizer[LoopBelief]):
    name = "stdcl"
    centralized = True

    def __init__(
        self,
        believed: Believed,
        *,
        weights: str = "stdcl",
        feedback: Feedback = "learned",
        confidence: Confidence = "em",
        gain: float = 0.05,
    ) -> None:
        super().__init__(believed)
        self.base = DynamicMds(believed, confidence=confidence)
        self.feedback, self.gain = feedback, gain
        self.network = learned(StGnn, weights).double().requires_grad_(False)

    def learn(self, network: StGnn) -> None:
        """Correct by this network from now on."""
        self.network = network

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> LoopBelief:
        base = self.base.reset(observation)
        shape = base.batch_size
        fixed = torch.zeros(shape, dtype=torch.bool, device=base.step.device)
        return LoopBelief(
            base=base,
            memory=forgotten(fixed, self.base.process.dim),
            past=self.network.start(shape, self.base.process.dim),
            confidence=base.variance.new_ones(*shape, shape[1]),
            batch_size=shape,
        )

    def step(self, belief: LoopBelief, observation: Observation) -> tuple[LoopBelief, Estimate]:
        with torch.no_grad():
            now = self.base.prepared(belief.base, observation)
            if self.feedback in ("paper", "links", "learned"):
                now = replace(now, confidence=belief.confidence)
            found = self.base.find(belief.base, now)
            weight, shift = self.base.weigh(found.position, now)
            scene, memory = look(now, found, weight, shift, self.base.std, belief.memory)
        correction, past = self.network(scene, belief.past)
        attached = self.attached(belief, now, found, scene, weight, shift)
        best = self.corrected(now, found, attached, correction)
        feeds = self.feedback in ("positions", "learned")
        kept, _ = self.base.concluded(belief.base, now, best if feeds else found)
        _, estimate = self.base.concluded(belief.base, now, best)
        after = build(
            LoopBelief,
            belief.batch_size,
            base=kept,
            memory=memory,
            past=past,
            confidence=self.fed_back(belief.confidence, now, best, correction),
        )
        return after, estimate

    def attached(self, belief, now, found, scene, weight, shift):
        """The position found, with what it owes to what was fed back (first order, neighbours held)."""
        if not torch.is_grad_enabled():
            return found.position
        d = self.base.process.dim
        m = belief.base.state[..., :d]
        y = found.position
        gain = scene.gain.detach()
        push = scene.trust[..., None] * (m - m.detach())
        if belief.confidence.requires_grad:
            from agents.stgnn.features import along_links
            c = belief.confidence
            r = now.links.distance - scene.length - shift
            s = (c - c.detach()) * (weight / c.detach()) * r
            push = push + along_links(scene.position, s, scene.length)
        move = (gain @ push.unsqueeze(-1))[..., 0]
        return y + torch.where(now.fixed.unsqueeze(-1), 0.0, move)

    def corrected(self, now: Prepared, found: Found, y, correction: Correction) -> Found:
        """p̂ = p + γ Δp (eq. 34); who is fixed stays."""
        moves = ~now.fixed
        position = torch.where(moves.unsqueeze(-1), y + correction.offset.double(), y)
        spread = correction.spread.double()
        variance = torch.where(moves, found.variance * spread, found.variance)
        return Found(position, variance)

    def fed_back(self, old, now, best, correction):
        if self.feedback not in ("paper", "links", "learned"):
            return old
        if self.feedback == "paper":
            off = (now.links.distance - lengths(best.position)).abs() / self.base.std
            wanted = torch.exp(-self.gain * off)
        else:
            wanted = correction.confidence.double()
        change = (wanted.clamp_min(_LEAST) / old).log()
        new = old * torch.exp(_RATE * torch.tanh(change / _RATE))
        return torch.where(now.links.mask, new, old)
