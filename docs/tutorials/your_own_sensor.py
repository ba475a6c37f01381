# %% [markdown]
# # Your own sensor
#
# A sensor needs three pieces: what it measures, how a filter reads it, and what it tells at best.
# Nothing else of coloc changes.
#
# As an example: a spinning radar on the floor that sees how far away each UAV is along the ground.

# %%
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from agents.models.measurements import Block, Measurement, measures, noise_std, usable
from coloc_env import make_scenario, noise
from coloc_env.bounds.information import own_information
from coloc_env.sensors import Layout, Leaf, Sensor, Window
from coloc_env.sensors.base import MASK
from training.evaluation.evaluate import evaluate

torch.set_num_threads(1)

# %% [markdown]
# ## What it measures
#
# `leaves` is what it adds to each UAV's observation: vectors of float32. One that is not always
# there has a mask beside it. `sample` gives them for R worlds, K steps and N UAVs at once, from
# the true motion. Noise comes from a stream of its own name, so that no other number changes.


# %%
@dataclass(frozen=True)
class Radar(Sensor):
    """z = √((x − a)² + (y − b)²) + N(0, σ²), in m, within ``reach`` m of (a, b)."""

    at: tuple[float, float]
    std: float = 0.2
    reach: float = 25.0

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"radar": Leaf(1, low=0.0, unit="m"), "radar_mask": Leaf(1, *MASK)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        d = ground(window.motion.position, self.at).float()  # [R, K, N, 1]
        white = noise.normal(window.keys, "radar", d[0, 0].numel()).view(d.shape)
        there = (d < self.reach) & window.alive.unsqueeze(-1)
        return {"radar": (d + self.std * white).clamp_min(0) * there, "radar_mask": there.float()}


def ground(position: Tensor, at: tuple[float, float]) -> Tensor:
    """Distance along the ground, m, [..., 1]."""
    return (position[..., :2] - position.new_tensor(at)).norm(dim=-1, keepdim=True)


# %% [markdown]
# ## How a filter reads it
#
# The residual z − h(x) and the Jacobian of h, registered for the sensor. Every Kalman filter,
# particle filter and factor graph that takes sensors of any kind uses it from here on.


# %%
@measures(Radar)
class RadarDistances(Measurement):
    def __init__(self, sensor: Radar) -> None:
        self.at, self.variance = sensor.at, noise_std(sensor.std) ** 2

    def linearize(self, process, x, observation, neighbours, derivatives=True):
        z = observation["radar"].to(x.dtype).unsqueeze(-2)  # [B, N, m = 1, k = 1]
        z, mask = usable(z, observation["radar_mask"] > 0)
        h = ground(x, self.at).unsqueeze(-2).clamp_min(1e-9)
        jacobian = x.new_zeros(*h.shape, process.error_size)
        jacobian[..., :2] = (x[..., :2] - x.new_tensor(self.at))[..., None, None, :] / h.unsqueeze(
            -1
        )
        return Block(
            residual=z - h,
            jacobian=jacobian,  # ∂h/∂p = (p − a) / |p − a|, along the ground
            variance=x.new_tensor(self.variance).expand_as(h),
            mask=mask.expand(h.shape[:-1]),
        )


# %% [markdown]
# ## What it tells at best
#
# Fisher's information $H^T R^{-1} H$ at the truth, about position and attitude. The posterior
# Cramér–Rao bound counts it.


# %%
@own_information.register
def _(sensor: Radar, truth, seen):
    h = ground(truth.position, sensor.at).clamp_min(1e-9)
    jacobian = truth.position.new_zeros(*h.shape[:-1], 1, 6)
    jacobian[..., :2] = ((truth.position[..., :2] - h.new_tensor(sensor.at)) / h).unsqueeze(-2)
    there = (seen["radar_mask"] > 0).unsqueeze(-1)
    return there * (jacobian.mT @ jacobian) / sensor.std**2


# %% [markdown]
# ## In a room
#
# A scenario has what is true, and what the team believes: here the same. Two landmarks leave a
# team unsure; what does a radar add?

# %%
room = make_scenario("indoor-v0", landmarks=2, horizon=200)
radar = Radar(at=(0.0, 0.0))
with_radar = replace(
    room,
    name="radar-room",
    sensors=(*room.sensors, radar),
    believed_sensors=(*room.believed_sensors, radar),
)
for scenario in (room, with_radar):
    found = evaluate(scenario, ["ekf", "ekf:robust=huber"], runs=3).summary
    rows = {"bound": found["bound"], **found["agents"]}
    print(scenario.name, {name: round(row["rmse"], 3) for name, row in rows.items()})

# %% [markdown]
# ## Check it
#
# A wrong Jacobian makes a filter worse, not wrong enough to notice. Finite differences notice:

# %%
from agents import make
from coloc_env.world import World

world = World(with_radar, 4)
world.reset(0)
ekf = make("ekf", with_radar)
observation, process = world.observation(), ekf.process
x, _ = process.initial(observation["prior"].double())
model = RadarDistances(radar)
block, numeric = model.linearize(process, x, observation, None), []
for i in range(process.error_size):
    step = torch.zeros(*x.shape[:-1], process.error_size, dtype=x.dtype)
    step[..., i] = 1e-6
    up, down = (
        model.linearize(process, process.boxplus(x, s), observation, None).residual
        for s in (step, -step)
    )
    numeric.append((down - up) / 2e-6)
assert torch.allclose(block.jacobian, torch.stack(numeric, -1), atol=1e-6)

# %% [markdown]
# In a package of your own, with the scenario named by an entry point, every `coloc` command sees
# it: [your own sensor, installed](../how-to/own-sensor.md).
