"""What each candidate exchange on a channel would do: features that one network scores."""

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from agents.tasks.gains import log_gain
from agents.tasks.memory import TaskMemory, own_sigma
from agents.tasks.task import Task

WIDTH = 14
_NEAR = 1.5  # times the reach: who may disturb each other


def candidates(task: Task, memory: TaskMemory) -> Float32[Tensor, "B n C K"]:
    """Features of every choice of every UAV, within [−1, 1]; of silence and of a call alike.

    Own and the team's predicted gain; whether the gain is the UAV's own best; how its best compares
    to those of all who may disturb it, and whether it is the largest there (ties: the lower number
    has it); the same of the team's gain, beside those of whose exchanges would spoil this one or be
    spoiled by it; how many UAVs are near the caller and near the one called; distance; σ of both;
    whether it is a call at all.
    """
    n, more = task.n_agents, memory.more
    gain, team = more["gain"], more["team_gain"]  # [B, n, C − 1]
    place = torch.cat((memory.position, task.anchors.expand(len(gain), -1, -1)), 1)
    target = task.targets_of(n)  # type: ignore[attr-defined]
    apart = _distances(place)[:, :n]  # [B, n, n + A]
    best = gain.amax(-1)  # [B, n]
    rivals = (apart[..., :n] <= _NEAR * task.radius) & ~torch.eye(n, dtype=torch.bool)
    most = torch.where(rivals, best.unsqueeze(1), 0.0).amax(-1)
    number = torch.arange(n)
    before = number.unsqueeze(0) < number.unsqueeze(1)  # [i, j]: j goes first in a tie
    beaten = (best.unsqueeze(1) > best.unsqueeze(2)) | (
        (best.unsqueeze(1) == best.unsqueeze(2)) & before
    )
    largest = ~(rivals & beaten).any(-1) & (best > 0)
    worth, choice = team.max(-1)  # [B, n]: the best exchange of each for the team
    chosen = target.expand(len(gain), -1, -1).gather(2, choice.unsqueeze(-1))[..., 0]  # [B, n]
    reach = apart <= task.radius
    spoils = reach[:, :, target].movedim(1, -1)  # [B, i, c, j]: j is near whom i would call
    spoiled = reach.gather(2, chosen.unsqueeze(1).expand(-1, n, -1)).unsqueeze(2)  # [B, i, 1, j]
    same = target[..., None] == chosen[:, None, None]
    partner = (target[..., None] == number) | (chosen.unsqueeze(1) == number[:, None]).unsqueeze(2)
    others = ~torch.eye(n, dtype=torch.bool).unsqueeze(1)  # [i, 1, j]
    clashes = (spoils | spoiled | same | partner) & others
    rival = torch.where(clashes, worth[:, None, None], 0.0).amax(-1)  # [B, n, C − 1]
    crowd = (_distances(place)[:, :, :n] <= task.radius).to(gain.dtype).sum(-1) - 1  # [B, n + A]
    sigma = own_sigma(memory.joint)
    sigmas = torch.cat((sigma, torch.zeros_like(place[:, n:, 0])), 1)

    def each(value: Float[Tensor, "B n"]) -> Float[Tensor, "B n C"]:
        return value.unsqueeze(-1).expand_as(gain)

    def called(value: Float[Tensor, "B M"]) -> Float[Tensor, "B n C"]:
        return value[:, target]

    calls = (
        log_gain(gain),
        log_gain(team),
        2 * (gain >= each(best)).to(gain.dtype) - 1,
        (log_gain(gain) - log_gain(each(most))).clamp(-1, 1),
        2 * each(largest.to(gain.dtype)) - 1,
        2 * (team >= each(worth)).to(gain.dtype) - 1,
        (log_gain(team) - log_gain(rival)).clamp(-1, 1),
        2 * ((team >= rival) & (team > 0)).to(gain.dtype) - 1,
        2 * each(crowd[:, :n]) / max(n - 1, 1) - 1,
        2 * called(crowd) / max(n - 1, 1) - 1,
        more["distance"] / task.radius - 1,
        each(sigma.clamp(max=5.0)) / 2.5 - 1,
        called(sigmas.clamp(max=5.0)) / 2.5 - 1,
        torch.ones_like(gain),
    )
    of_calls = torch.stack(calls, -1)
    silence = of_calls.new_zeros(*gain.shape[:2], 1, WIDTH)
    silence[..., 0, 3] = (log_gain(best) - log_gain(most)).clamp(-1, 1)
    silence[..., 0, 4] = of_calls[..., 0, 4]
    silence[..., 0, 11] = of_calls[..., 0, 11]
    silence[..., -1] = -1.0
    return torch.cat((silence, of_calls), 2).clamp(-1.0, 1.0)


def _distances(place: Float[Tensor, "B M d"]) -> Float[Tensor, "B M M"]:
    return (place.unsqueeze(2) - place.unsqueeze(1)).norm(dim=-1)
