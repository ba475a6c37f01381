"""Filters that trust each measurement as far as a network says: ``ekf_trust``, ``pfnn_trust``."""

from typing import Any

import torch

from agents.checkpoint import load
from agents.ekf import CooperativeEkf
from agents.localizer import register
from agents.pf import AdaptiveParticleFilter
from agents.trust import TrustNetwork, TrustScreen
from coloc_env.scenario import Believed


def trust_network(weights: str) -> TrustNetwork:
    """The networks of a checkpoint (its name or path); untrained ones for ``none``."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = TrustNetwork()
    if weights != "none":
        load(weights, network)
    return network.requires_grad_(False)


@register("ekf_trust")
class TrustingEkf(CooperativeEkf):
    """Cooperative EKF with learned trust in every landmark, bearing and range.

    Two Huber iterations (five where the prior is broad), then one with the weights and range biases
    that the networks give to what they see. ``weights``: a checkpoint's name or path, or ``none``.
    """

    name = "ekf_trust"

    def __init__(
        self,
        believed: Believed,
        *,
        weights: str = "trust",
        iterations: int = 3,
        **options: Any,
    ) -> None:
        if options.get("robust", "none") != "none":
            raise ValueError("robust is not allowed beside learned trust: none")
        super().__init__(believed, iterations=iterations, **options)
        self.learn(trust_network(weights))

    def learn(self, network: TrustNetwork) -> None:
        """Judge by these networks from now on."""
        self.screen = TrustScreen(self.process, self.models, network)


@register("pfnn_trust")
class TrustingParticleFilter(AdaptiveParticleFilter):
    """Adaptive particle filter with learned trust in every landmark, bearing and range.

    The networks of ``ekf_trust`` judge by a Gaussian update at the cloud's moments; their weights
    and biases enter every particle's likelihood. Other options as ``apf`` has them.
    """

    name = "pfnn_trust"

    def __init__(self, believed: Believed, *, weights: str = "trust", **options: Any) -> None:
        if options.get("robust", "none") != "none":
            raise ValueError("robust is not allowed beside learned trust: none")
        super().__init__(believed, **options)
        self.screen = TrustScreen(self.process, self.models, trust_network(weights))
        self.screens = True
