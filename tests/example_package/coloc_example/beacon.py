"""A sensor of one's own: what it measures, how filters read it, its information, a room with it."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from agents.models.measurements import Block, Measurement, Neighbours, measures, noise_std, usable
from agents.models.process import Process
from coloc_env import noise
from coloc_env.bounds.information import own_information
from coloc_env.geometry import cross_matrix, rotation_matrix
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation
from coloc_env.options import Count, PositiveCount, PositiveMetres
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Layout, Leaf, Sensor, Window


# 1. The sensor.
@dataclass(frozen=True)
class Beacon(Sensor):
    """Where a beacon stands, seen from the UAV: z = Rᵀ(c − p) + N(0, σ² I), in m, body frame.

    ``at`` is c (m, world), ``std`` is σ (m per axis). Leaf ``beacon`` [3].
    """

    at: tuple[float, float, float]
    std: float = 0.3

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"beacon": Leaf(3, unit="m", frame="body")}

    def sample(
        self, window: Window, placed: dict[str, Tensor]
    ) -> dict[str, Float32[Tensor, "R K N F"]]:
        """R worlds, K steps, N UAVs at once; a failed UAV's entries are 0."""
        p, rotation = window.motion.position, rotation_matrix(window.motion.attitude)
        seen = _seen(p, rotation, p.new_tensor(self.at)).float()
        white = noise.normal(window.keys, "beacon", seen[0, 0].numel()).view(seen.shape)
        return {"beacon": (seen + self.std * white) * window.alive.unsqueeze(-1)}


def _seen(
    p: Float[Tensor, "*s 3"], rotation: Float[Tensor, "*s 3 3"], c: Float[Tensor, "3"]
) -> Float[Tensor, "*s 3"]:
    """h = Rᵀ(c − p)."""
    return ((c - p).unsqueeze(-2) @ rotation).squeeze(-2)


# 2. Its measurement model.
@measures(Beacon)
class BeaconVectors(Measurement):
    """Built from the sensor as the team believes it to be."""

    def __init__(self, sensor: Beacon) -> None:
        self.at, self.variance = sensor.at, noise_std(sensor.std) ** 2

    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        """One measurement (m = 1) of three numbers (k = 3)."""
        rotation, turn = process.rotation(x), process.attitude_error
        if rotation is None or turn is None:
            raise ValueError("Beacon is in the body frame: the motion model has no attitude")
        z = observation["beacon"].to(x.dtype).unsqueeze(-2)
        z, mask = usable(z, torch.ones_like(z[..., 0], dtype=torch.bool))  # false: not finite
        h = _seen(x[..., :3], rotation, x.new_tensor(self.at)).unsqueeze(-2)
        jacobian = x.new_zeros(0)
        if derivatives:
            jacobian = x.new_zeros(*h.shape, process.error_size)
            jacobian[..., :3] = -rotation.mT.unsqueeze(-3)  # ∂h/∂δp = −Rᵀ
            jacobian[..., turn] = cross_matrix(h)  # ∂h/∂δθ = [h]×, with R exp(δθ)
        return Block(
            residual=z - h,
            jacobian=jacobian,
            variance=x.new_tensor(self.variance).expand_as(h),
            mask=mask.expand(h.shape[:-1]),
        )


# 3. Its information: Hᵀ R⁻¹ H at the truth, about (δp, δθ).
@own_information.register
def _(sensor: Beacon, truth: Kinematics, seen: Observation) -> Float64[Tensor, "B N 6 6"]:
    rotation = rotation_matrix(truth.attitude)
    h = _seen(truth.position, rotation, truth.position.new_tensor(sensor.at))
    jacobian = torch.cat((-rotation.mT, cross_matrix(h)), -1)
    return jacobian.mT @ jacobian / sensor.std**2


# 4. A scenario that has it.
def beacon_room(
    *,
    n_uavs: PositiveCount = 6,
    landmarks: Count = 0,
    beacon_std: PositiveMetres = 0.3,
    horizon: PositiveCount = 300,
) -> Scenario:
    """A room with a beacon in its middle."""
    plain = make_scenario(
        "indoor-v0", n_uavs=n_uavs, landmarks=landmarks, uwb=False, horizon=horizon
    )
    beacon = Beacon(at=(15.0, 10.0, 2.5), std=beacon_std)
    return replace(
        plain,
        name="beacon-room-v0",
        sensors=(*plain.sensors, beacon),
        believed_sensors=(*plain.believed_sensors, beacon),
    )
