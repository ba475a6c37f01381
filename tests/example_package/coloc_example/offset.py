"""A training of one's own."""

from coloc_env.options import PositiveCount
from training.learning.run import Training


def offset(*, epochs: PositiveCount = 1) -> Training:
    """Learns nothing: shows that a training is found."""
    raise ValueError(f"epochs={epochs}: this example only shows that it is found")
