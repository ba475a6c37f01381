"""Latent states of particles: a Wasserstein auto-encoder of windows, and a learned step in time.

A window is what a particle's last W positions and velocities are beside a reference's: W rows
[δp, T δv], the newest last, world frame, in m; T is the window's length in s, so that nothing else
depends on the step's length.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from agents.layers import row_product
from agents.weights import Learned

WINDOW, CHANNELS = 8, 6  # steps, and numbers of each
_SLOPE = 0.2  # of the leaky ReLU


class Homogeneous(nn.Module):
    """f(x) = A x + C leaky(B x): no biases, so f(s x) = s f(x) for s > 0, and clouds that are
    metres or centimetres wide are all the same to it."""

    def __init__(self, inputs: int, outputs: int, hidden: int) -> None:
        super().__init__()
        self.straight, self.into, self.out = (
            nn.Linear(i, o, bias=False)
            for i, o in ((inputs, outputs), (inputs, hidden), (hidden, outputs))
        )
        nn.init.zeros_(self.out.weight)  # a linear map at first

    def forward(self, x: Float[Tensor, "*s m i"], last: int = 0) -> Float[Tensor, "*s m o"]:
        """All outputs, or the ``last`` few alone."""
        bent = nn.functional.leaky_relu(row_product(x, self.into.weight.mT), _SLOPE)
        straight, out = (one.weight[-last:].mT for one in (self.straight, self.out))
        return row_product(x, straight) + row_product(bent, out)


class LatentModel(Learned):
    """Encoder z = E(w), decoder ŵ = D(z), and latent step z' = F(z, T δu), δu (m/s) the velocity
    that a particle gains in the step beside what the reference gains."""

    kind = "dlspf"
    features = ("dx", "dy", "dz", "Tdvx", "Tdvy", "Tdvz")

    def __init__(self, *, latents: int = 8, hidden: int = 48) -> None:
        super().__init__()
        self.architecture = {"latents": latents, "hidden": hidden}
        self.latents = latents
        self.encoder = Homogeneous(WINDOW * CHANNELS, latents, hidden)
        self.decoder = Homogeneous(latents, WINDOW * CHANNELS, hidden)
        self.transition = Homogeneous(latents + 3, latents, hidden)

    def encode(self, window: Float[Tensor, "*s m W 6"]) -> Float[Tensor, "*s m L"]:
        encoded: Tensor = self.encoder(window.flatten(-2))
        return encoded

    def decode(self, z: Float[Tensor, "*s m L"]) -> Float[Tensor, "*s m W 6"]:
        decoded: Tensor = self.decoder(z)
        return decoded.unflatten(-1, (WINDOW, CHANNELS))

    def newest(self, z: Float[Tensor, "*s m L"]) -> Float[Tensor, "*s m 6"]:
        """The last row of what ``decode`` gives."""
        decoded: Tensor = self.decoder(z, CHANNELS)
        return decoded

    def advance(
        self, z: Float[Tensor, "*s m L"], push: Float[Tensor, "*s m 3"]
    ) -> Float[Tensor, "*s m L"]:
        """A step later; ``push`` is T δu."""
        later: Tensor = self.transition(torch.cat((z, push), -1))
        return later


def unaccelerated(newest: Float[Tensor, "*s 6"]) -> Float[Tensor, "*s W 6"]:
    """The window that leads to [δp, T δv] without acceleration: δp − (W − 1 − k) δv dt."""
    age = torch.arange(WINDOW - 1, -1, -1, device=newest.device, dtype=newest.dtype) / WINDOW
    apart, pace = newest[..., None, :3], newest[..., None, 3:]
    places = apart - age.unsqueeze(-1) * pace
    return torch.cat((places, pace.expand_as(places)), -1)
