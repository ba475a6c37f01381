"""What agents of every task see of the estimates, part by part, each within [−1, 1]."""

from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from agents.tasks.memory import TaskMemory, own_covariance
from coloc_env.observation import Observation

if TYPE_CHECKING:
    from agents.tasks.task import Task

_SIGMAS = (0.05, 20.0)  # m: what log σ is scaled by
_OLDEST = 20.0  # s: what ages are scaled by
_NEAR = 10.0  # m

ABOUT = {
    "position": "own estimated position, the arena as −1 … 1",
    "velocity": "own velocity / top speed",
    "sigma": "log σ of the own position along the major and the minor horizontal axis, and upright "
    "where there are three, 0.05 … 20 m as −1 … 1",
    "ellipse": "(P_xx − P_yy) / tr P and 2 P_xy / tr P",
    "neighbours": "each other UAV that acts, the nearest first: Δ / 2R, Δ / 10 m, log σ, whether "
    "it was ranged to, velocity / top speed",
    "targets": "each UAV that does not act: Δ / 2R, Δ / 10 m, log σ, whether it was ranged to",
    "anchors": "each anchor: Δ / 2R, whether it was ranged to",
    "clock": "time and own number, first to last as −1 … 1",
}
AGED = ", age of what was heard, 0 … 20 s as −1 … 1"


class Others(NamedTuple):
    """What each agent knows of everybody: estimates (m, m/s), log σ as −1 … 1, and their ages
    (steps; None: all are of now)."""

    position: Float[Tensor, "B n N d"]
    velocity: Float[Tensor, "B n N d"]
    sigma: Float[Tensor, "B n N"]
    age: Float[Tensor, "B n N"] | None


def common(task: "Task", memory: TaskMemory) -> dict[str, Float32[Tensor, "B n F"]]:
    """Own estimate, neighbours (the nearest first), targets, anchors, time and number."""
    n, b, total = task.n_agents, len(memory.position), memory.position.shape[1]
    own = memory.position[:, :n]
    p = own_covariance(memory.joint)[:, :n]
    shape = torch.stack((p[..., 0, 0] - p[..., 1, 1], 2 * p[..., 0, 1]), -1)
    parts = {
        "position": 2 * (own - task.low) / (task.high - task.low) - 1,
        "velocity": memory.velocity[:, :n] / task.v_max,
        "sigma": log_sigmas(p),
        "ellipse": shape / p.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True).clamp_min(1e-9),
    }
    others = task.others(memory)
    about = _about(task, memory, others)
    if n > 1:
        index = task.ring.unsqueeze(-1).expand(b, -1, -1, about.shape[-1])
        each = about.gather(2, index)
        moving = others.velocity.gather(2, index[..., :1].expand(-1, -1, -1, task.dim))
        each = torch.cat((each, moving / task.v_max), -1)
        squared = (each[..., : task.dim] ** 2).sum(-1)
        if others.age is not None:  # who was never heard comes last
            never = others.age.isinf().gather(2, task.ring.expand(b, -1, -1))
            squared = torch.where(never, torch.inf, squared)
        order = squared.argsort(dim=-1, stable=True).unsqueeze(-1).expand_as(each)
        parts["neighbours"] = each.gather(2, order).flatten(2)
    if total > n:
        parts["targets"] = about[:, :, n:].flatten(2)
    if len(task.anchors):
        apart = task.anchors - own.unsqueeze(2)
        near = memory.seen[:, :n, total:].to(own.dtype).unsqueeze(-1)
        parts["anchors"] = torch.cat((apart / (2 * task.radius), near), -1).flatten(2)
    time = 2 * memory.step[:, :n].to(own.dtype) / max(task.scenario.horizon - 1, 1) - 1
    parts["clock"] = torch.stack((time, task.numbers.expand(b, n)), -1)
    return parts


def _about(task: "Task", memory: TaskMemory, others: Others) -> Float32[Tensor, "B n N F"]:
    """Where each agent believes everybody to be: Δ / 2R, Δ / 10 m, log σ, in reach, and its age."""
    n, total = task.n_agents, memory.position.shape[1]
    apart = others.position - memory.position[:, :n].unsqueeze(2)
    reach = memory.seen[:, :n, :total].to(apart.dtype).unsqueeze(-1)
    sigma = others.sigma.unsqueeze(-1)
    if others.age is None:
        return torch.cat((apart / (2 * task.radius), apart / _NEAR, sigma, reach), -1)
    age = others.age.unsqueeze(-1)
    apart, sigma = (torch.where(age.isinf(), x, y) for x, y in ((0.0, apart), (1.0, sigma)))
    age = (2 * age / _OLDEST - 1).clamp(max=1.0)
    return torch.cat((apart / (2 * task.radius), apart / _NEAR, sigma, reach, age), -1)


def free(task: "Task", memory: TaskMemory) -> Others:
    """Everybody's estimates, of now."""
    n, (b, total) = task.n_agents, memory.position.shape[:2]
    shape = (b, n, total, task.dim)
    sigma = log_sigmas(own_covariance(memory.joint))[..., 0]
    return Others(
        memory.position.unsqueeze(1).expand(shape),
        memory.velocity.unsqueeze(1).expand(shape),
        sigma.unsqueeze(1).expand(shape[:3]),
        None,
    )


def unheard(task: "Task", prior: Float32[Tensor, "B N F"]) -> dict[str, Tensor]:
    """What agents know of others before they hear them: of targets the prior, of UAVs nothing."""
    b, total = prior.shape[:2]
    n, d = task.n_agents, task.dim
    heard = prior.new_zeros(b, total, total, 2 * d + 1)
    age = prior.new_full((b, total, total), torch.inf)
    heard[..., n:, :d] = prior[:, None, n:, :d]
    heard[..., n:, -1] = _scaled(prior[:, None, n:, -2 - d].log())
    age[..., n:] = 0.0
    return {"heard": heard, "age": age}


def hear(task: "Task", memory: TaskMemory, observation: Observation) -> dict[str, Tensor]:
    """What agents know of others after a step: estimates in the messages that came, which were sent
    a step ago (or earlier, where messages are late), and of targets those that they ranged to."""
    n, d, (b, total) = task.n_agents, task.dim, memory.position.shape[:2]
    came = observation["message_mask"] > 0
    sent = observation["messages"].view(b, total, total, 3 * d)
    spread = _scaled(sent[..., 2 * d :].amax(-1, keepdim=True))
    new = torch.cat((sent[..., : 2 * d], spread), -1)
    heard = torch.where(came.unsqueeze(-1), new, memory.more["heard"])
    late = 1.0 + task.scenario.network.delay
    age = torch.where(came, late, memory.more["age"] + 1.0)
    if total > n:
        ranged = memory.seen[:, :, n:total]
        sigma = log_sigmas(own_covariance(memory.joint)[:, n:])[..., :1]
        now = torch.cat((memory.position[:, n:], memory.velocity[:, n:], sigma), -1)
        latest = torch.where(ranged.unsqueeze(-1), now.unsqueeze(1), heard[:, :, n:])
        heard = torch.cat((heard[:, :, :n], latest), 2)
        age = torch.cat((age[..., :n], torch.where(ranged, 0.0, age[..., n:])), -1)
    return {"heard": heard, "age": age}


def remembered(task: "Task", memory: TaskMemory) -> Others:
    """What each agent heard last of everybody."""
    n, d = task.n_agents, task.dim
    heard = memory.more["heard"][:, :n]
    return Others(heard[..., :d], heard[..., d : 2 * d], heard[..., -1], memory.more["age"][:, :n])


def log_sigmas(p: Float[Tensor, "*s d d"]) -> Float[Tensor, "*s d"]:
    """log σ along the major and the minor horizontal axis, and upright where there are three, 0.05
    … 20 m as −1 … 1."""
    half, trace = 0.5 * (p[..., 0, 0] - p[..., 1, 1]), 0.5 * (p[..., 0, 0] + p[..., 1, 1])
    root = (half**2 + p[..., 0, 1] ** 2).sqrt()
    axes = [trace + root, trace - root, *(p[..., i, i] for i in range(2, p.shape[-1]))]
    return _scaled(0.5 * torch.stack(axes, -1).clamp_min(1e-12).log())


def _scaled(log_sigma: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    low, high = (torch.tensor(x, device=log_sigma.device).log() for x in _SIGMAS)
    return 2 * (log_sigma - low) / (high - low) - 1
