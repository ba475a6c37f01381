"""Learned trust per measurement: networks, their features, and the screen that uses them."""

from agents.trust.network import TrustNetwork
from agents.trust.screen import TrustScreen

__all__ = ["TrustNetwork", "TrustScreen"]
