"""Robust measurement handling as options that combine (PF-NN paper, section 2.5)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements import Block, Measurement
from agents.models.process import Process
from agents.robust.cross import CrossValidation
from agents.robust.gate import gate_weights, residual_gate_weights
from agents.robust.ransac import consensus_weights
from agents.robust.screen import Prediction, Screen, Trust
from agents.robust.soft import SOFT
from agents.robust.temporal import TemporalConsistency
from coloc_env.observation import Observation

METHODS = (*SOFT, "gate", "ransac", "temporal", "cross")
_STEP = 0.1  # what a step counts in the running share of measurements left out
_MOST = 0.5  # the share beyond which it is not the measurements that are wrong
Test = Sequence[Float[Tensor, "B N m"] | None]  # weights for each block, None for no objection


@dataclass(frozen=True)
class Verdict:
    """Outcome of a step's hard tests: weights of 0 or 1, the running share of each model's
    measurements that they would leave out, and where the gate has to look again at the end."""

    weights: list[Float[Tensor, "B N m"]]
    left_out: Float[Tensor, "B N M"]
    again: Bool[Tensor, "B N M"]


class RobustScreen(Screen):
    """Any of ``METHODS``, joined by ``+``; ``none`` trusts everything.

    ``huber`` reweights at every iteration, or in its place ``student`` or ``mixture`` (see
    ``heavy_tails``). The others are hard tests of the innovations, made once
    per step, and a measurement stays if it passes all of them. Where the prior is broad, passing
    the ``gate`` (χ² quantile ``probability``) means little; there it judges again at the last
    iteration, by the residuals that are left. Where the tests go on leaving out most of what a
    sensor measures, it is the prediction that is wrong: then all of it passes, or a UAV that once
    went astray could never return.
    """

    def __init__(
        self, process: Process, models: Sequence[Measurement], robust: str, probability: float
    ) -> None:
        super().__init__(process, models)
        self.methods = _parsed(robust)
        self.probability = probability
        self.judges = bool(self.methods)
        self.extra = 3 if self.judges else 0
        self.hard = bool(self.methods - SOFT.keys())
        soft = self.methods & SOFT.keys()
        self.soft = SOFT[min(soft)] if soft else None
        remembers = "temporal" in self.methods and bool(models)
        self.temporal = TemporalConsistency(process, models) if remembers else None
        self.cross = CrossValidation(process, models) if "cross" in self.methods else None
        self.exchanges = self.cross is not None and self.cross.pair is not None

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        """The shares left out, then what temporal consistency remembers."""
        shares = len(self.models) if self.hard else 0
        start = observation["prior"].new_zeros(*observation.batch_size, shares).double()
        if self.temporal is None:
            return start
        return torch.cat((start, self.temporal.memory(observation)), -1)

    def judge(self, blocks: Sequence[Block], prediction: Prediction) -> Verdict | None:
        if not self.hard:
            return None
        tests = zip(*self._tests(blocks, prediction), strict=True)
        shares = prediction.memory[..., : len(blocks)].unbind(-1)
        weights, left_out = [], []
        for block, passed, share in zip(blocks, tests, shares, strict=True):
            weight = torch.ones_like(block.residual[..., 0])
            for one in passed:
                weight = weight if one is None else weight * one
            count = block.mask.sum(-1)
            now = ((1 - weight) * block.mask).sum(-1) / count.clamp_min(1)
            share = torch.where(count > 0, (1 - _STEP) * share + _STEP * now, share)
            weights.append(weight.masked_fill((share > _MOST).unsqueeze(-1), 1.0))
            left_out.append(share)
        running = torch.stack(left_out, -1)
        again = prediction.broad(self.process.dim).unsqueeze(-1) & (running <= _MOST)
        return Verdict(weights, running, again)

    def _tests(self, blocks: Sequence[Block], prediction: Prediction) -> list[Test]:
        tests: list[Test] = []
        covariance, likely = prediction.covariance, blocks
        if "gate" in self.methods:
            inside = [gate_weights(block, covariance, self.probability) for block in blocks]
            tests.append(inside)
            both = zip(blocks, inside, strict=True)
            likely = [replace(block, mask=block.mask & (weight > 0)) for block, weight in both]
        if "ransac" in self.methods:  # only what is likely alone may vote
            pairs = zip(self.models, likely, strict=True)
            tests.append([consensus_weights(model, block, covariance) for model, block in pairs])
        if self.temporal is not None:
            memory = prediction.memory[..., len(blocks) :]
            tests.append(self.temporal.judge(blocks, prediction, memory))
        if self.cross is not None:
            tests.append(self.cross.judge(blocks, prediction))
        return tests

    def weigh(self, blocks: Sequence[Block], evidence: Verdict | None, last: bool) -> list[Trust]:
        soft = [None if self.soft is None else self.soft(block) for block in blocks]
        if evidence is None:
            return [Trust(weight) for weight in soft]
        hard = evidence.weights
        if last and "gate" in self.methods:
            within = [residual_gate_weights(block, self.probability) for block in blocks]
            again = evidence.again.unsqueeze(-1).unbind(-2)
            judged = zip(hard, within, again, strict=True)
            hard = [torch.where(a, h * w, h) for h, w, a in judged]
        pairs = zip(soft, hard, strict=True)
        return [Trust(h if s is None else s * h) for s, h in pairs]

    def remember(
        self,
        prediction: Prediction,
        evidence: Verdict | None,
        after: Callable[[], Sequence[Block]],
    ) -> Float[Tensor, "B N K"]:
        if evidence is None:
            return prediction.memory
        if self.temporal is None:
            return evidence.left_out
        memory = prediction.memory[..., len(self.models) :]
        memory = self.temporal.remember(after(), prediction, memory)
        return torch.cat((evidence.left_out, memory), -1)


def _parsed(robust: str) -> frozenset[str]:
    names = () if robust == "none" else tuple(robust.split("+"))
    if any(name not in METHODS for name in names) or len(set(names)) < len(names):
        raise ValueError(
            f"robust={robust!r} is not allowed: none, or some of {', '.join(METHODS)} joined by +"
        )
    if len(set(names) & SOFT.keys()) > 1:
        raise ValueError(f"robust={robust!r} is not allowed: at most one of {', '.join(SOFT)}")
    return frozenset(names)
