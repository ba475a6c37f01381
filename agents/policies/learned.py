"""Policies that were learned in the environment, as localizers like any other."""

from typing import Any

import torch
from jaxtyping import Float32
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate, Localizer
from agents.policies.actor import Actor
from agents.weights import drawn_from, learned
from agents.wrappers.correction import Correction
from coloc_env.envs.action_mode import ActionMode
from coloc_env.envs.displacement import Displacement
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors import Sensor


def mode_of(believed: Believed, settings: dict[str, Any]) -> ActionMode:
    """The action mode that a card's ``mode`` describes; ValueError if it describes none."""
    kinds: dict[Any, Any] = {kind.name: kind for kind in (Correction, Displacement)}
    options = dict(settings)
    kind = options.pop("name", None)
    if not isinstance(kind, str | None) or kind not in kinds:
        raise ValueError(f"action mode {kind!r} is not one that policies have: {', '.join(kinds)}")
    try:
        mode: ActionMode = kinds[kind](believed, **options)
    except (AttributeError, TypeError) as error:
        raise ValueError(f"action mode {kind!r}: {error}") from None
    return mode


def inputs_of(mode: ActionMode) -> dict[str, int]:
    """What a policy reads in a mode: leaves and their widths."""
    leaves = mode.leaves
    return {name: leaves[name].width for name in mode.features}


def actor_for(mode: ActionMode, **options: Any) -> Actor:
    """An untrained network for a mode; ``options`` as ``Actor`` has them."""
    return Actor(mode.settings, inputs_of(mode), mode.dim, **options)


class PolicyBelief(TensorClass):
    """The action mode's memory (with a base localizer's belief) and the network's; batch (B, N)."""

    mode: Any
    network: Float32[Tensor, "B N m"]


class PolicyAgent(Localizer[PolicyBelief]):
    """A learned policy that takes its best action at every step.

    ``weights``: a checkpoint's name or path, whose card names its action mode and
    which base; ``none``: an untrained network that corrects an ``ekf``.
    """

    name = "policy"
    serves = (Sensor,)  # a policy reads what it was trained to read

    def __init__(self, believed: Believed, *, weights: str) -> None:
        super().__init__(believed)
        if weights == "none":
            self.mode: ActionMode = Correction(believed)
            with drawn_from(0):
                self.actor = actor_for(self.mode)
        else:
            self.actor = learned(Actor, weights)
            self.mode = mode_of(believed, self.actor.architecture["mode"])
            if self.mode.settings != self.actor.architecture["mode"]:
                raise ValueError(
                    f"{weights}: its card's mode is incomplete: {self.mode.settings} is needed"
                )
            known, given = self.actor.architecture["inputs"], inputs_of(self.mode)
            if known != given:
                raise ValueError(
                    f"{weights} was trained on the leaves {_words(known)}: this scenario has "
                    f"{_words(given)}"
                )
        self.actor.requires_grad_(False)

    @classmethod
    def of(cls, believed: Believed, actor: Actor, mode: ActionMode) -> "PolicyAgent":
        """One with a network at hand, whose training it follows."""
        agent = cls.__new__(cls)
        Localizer.__init__(agent, believed)
        agent.mode, agent.actor = mode, actor
        return agent

    def reset(self, observation: Observation) -> PolicyBelief:
        prior = observation["prior"]
        return PolicyBelief(
            mode=self.mode.reset(observation),
            network=prior.new_zeros(*prior.shape[:2], self.actor.memory_size),
            batch_size=prior.shape[:2],
        )

    @torch.no_grad()
    def step(self, belief: PolicyBelief, observation: Observation) -> tuple[PolicyBelief, Estimate]:
        memory, leaves = self.mode.observe(belief.mode, observation)
        seen = torch.cat([leaves[name] for name in self.mode.features], -1)
        action, network = self.actor.act(seen, belief.network)
        memory, estimate = self.mode.estimate(memory, action)
        d = self.mode.dim
        after = PolicyBelief(mode=memory, network=network, batch_size=belief.batch_size)
        return after, Estimate(
            position=estimate[..., :d],
            velocity=estimate[..., d : 2 * d],
            covariance=torch.diag_embed((2 * estimate[..., 2 * d :]).exp()),
            batch_size=belief.batch_size,
        )

    @property
    def exchanges(self) -> bool:
        return isinstance(self.mode, Correction) and self.mode.base.exchanges


def _words(inputs: dict[str, Any]) -> str:
    return ", ".join(f"{name}[{width}]" for name, width in inputs.items())
