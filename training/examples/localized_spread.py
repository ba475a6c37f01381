"""What localization costs mpe2's ``simple_spread``, and what training on estimates gives back.

A network learns to do what a controller does that knows the truth (DAgger: Ross, Gordon, Bagnell,
AISTATS 2011): from observations of the truth, or from estimates. Both, and the controller itself,
are then run on the truth and on estimates of three qualities.

    pip install -e ".[bench]"
    python -m training.examples.localized_spread

``--seeds 5`` and ``--out localized_spread.json`` make a study of it.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mpe2 import simple_spread_v3
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn

from agents.wrappers.adapters import simple_spread
from agents.wrappers.entries import replaced
from agents.wrappers.localization import Localization

N, HORIZON = 3, 25
QUALITIES: dict[str, dict[str, Any] | None] = {
    "truth": None,
    "INS, 4 anchors": {"anchors": 4},
    "ranges between agents only": {"anchors": 0},
    "4 anchors, 30 % NLOS": {"anchors": 4, "nlos": 0.3},
}
TRAINED_ON = ("truth", "ranges between agents only")
Policy = Callable[[Tensor], Tensor]  # of observations [B, N, 18], actions [B, N]


class Worlds:
    """B worlds side by side, their teams localized in one batch: what
    ``agents.wrappers.localized.Localized`` does with one."""

    def __init__(self, count: int, quality: str, seed: int) -> None:
        self.envs = [simple_spread_v3.parallel_env(max_cycles=HORIZON) for _ in range(count)]
        self.names = self.envs[0].possible_agents
        self.seed, self.overrides = seed, QUALITIES[quality]
        self.team: Localization | None = None

    def reset(self) -> Tensor:
        """True observations [B, N, 18] of new episodes."""
        seeds = range(self.seed, self.seed + len(self.envs))
        self.seed += len(self.envs)
        seen = [env.reset(seed=s)[0] for env, s in zip(self.envs, seeds, strict=True)]
        if self.overrides is not None:
            places = self.places()
            if self.team is None:
                self.team = simple_spread.localization("ekf", places, **self.overrides)
            self.team.restart(places, list(seeds))
        return self._rows(seen)

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """True observations, and rewards [B, N]."""
        seen, gained = [], []
        for env, row in zip(self.envs, actions.tolist(), strict=True):
            found = env.step(dict(zip(self.names, row, strict=True)))
            seen.append(found[0])
            gained.append([found[1][name] for name in self.names])
        if self.team is not None:
            self.team.move(self.places())
        return self._rows(seen), torch.tensor(gained)

    def known(self, true: Tensor) -> Tensor:
        """What agents observe in place of the truth."""
        if self.team is None:
            return true
        places, env = self.places(), self.envs[0]
        return torch.stack(
            [
                replaced(true[:, i], simple_spread.entries(env, i), places, self.team, i, env)
                for i in range(N)
            ],
            1,
        )

    def places(self) -> Tensor:
        """Where all agents are, [B, N, 2]."""
        return torch.from_numpy(np.stack([simple_spread.positions(env) for env in self.envs]))

    def _rows(self, seen: list[dict[str, np.ndarray]]) -> Tensor:
        return torch.from_numpy(np.array([[s[name] for name in self.names] for s in seen])).float()


def controller(observation: Tensor) -> Tensor:
    """To the landmark that an assignment over all agents gives each; brakes in time."""
    speed, own = observation[..., :2], observation[..., 2:4]
    landmarks = own.unsqueeze(-2) + observation[..., 4:10].unflatten(-1, (N, 2))
    others = own.unsqueeze(-2) + observation[..., 10:14].unflatten(-1, (N - 1, 2))
    goals = torch.empty_like(own)
    for b, i in np.ndindex(*own.shape[:2]):
        agents = torch.cat((others[b, i, :i], own[b, i, None], others[b, i, i:]))
        chosen = linear_sum_assignment(torch.cdist(agents, landmarks[b, i]).numpy())[1][i]
        goals[b, i] = landmarks[b, i, chosen]
    wanted = goals - own - 0.25 * speed
    axis = wanted.abs().argmax(-1, keepdim=True)
    along = wanted.gather(-1, axis)
    action = 1 + 2 * axis + (along > 0).long()
    return torch.where(along.abs() < 0.05, 0, action).squeeze(-1)


def mirrored(seen: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Observations [M, 18] and actions [M] as they would be in another order of landmarks and of
    others, with the axes swapped or turned around: a random one of the task's symmetries."""
    order = [0, 1, *(2 + torch.randperm(3)), *(5 + torch.randperm(2)), 7, 8]
    sign, swap = torch.randint(2, (2,)) * 2 - 1, int(torch.randint(2, ()))
    pairs = seen.unflatten(-1, (9, 2))[:, order] * sign
    axis, up = (actions - 1) // 2, (actions - 1) % 2
    up = torch.where(sign[axis.clamp_min(0)] > 0, up, 1 - up)
    turned = 1 + 2 * (axis ^ swap) + up
    pairs = pairs.flip(-1) if swap else pairs
    return pairs.flatten(1), torch.where(actions == 0, 0, turned)


def trained(quality: str, seed: int, rounds: int = 6, worlds: int = 100) -> Policy:
    """Of each round's worlds, all that was met is learnt; the learner acts from the second on."""
    torch.manual_seed(seed)
    env = Worlds(worlds, quality, 1_000_000 * (1 + seed))
    network = nn.Sequential(
        *(nn.Linear(18, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 5))
    )
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    met: list[Tensor] = []
    wanted: list[Tensor] = []

    def policy(seen: Tensor) -> Tensor:
        with torch.no_grad():
            return network(seen).argmax(-1)

    for turn in range(rounds):
        true = env.reset()
        for _ in range(HORIZON):
            seen, best = env.known(true), controller(true)
            met.append(seen.flatten(0, 1))
            wanted.append(best.flatten())
            true, _ = env.step(policy(seen) if turn else best)
        inputs, targets = torch.cat(met), torch.cat(wanted)
        for _ in range(8):
            for part in torch.randperm(len(inputs)).split(512):
                x, y = mirrored(inputs[part], targets[part])
                loss = nn.functional.cross_entropy(network(x), y)
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
    return policy


def measured(policy: Policy, quality: str, worlds: int = 128) -> dict[str, float]:
    """Per agent and episode the mean return and number of steps in collision, the share of episodes
    that end with each landmark covered (an agent within 0.1, as mpe2 counts), and the mean
    localization error (m): in worlds that no training saw."""
    env, true_return, hit = Worlds(worlds, quality, 10_000), 0.0, 0.0
    errors: list[float] = []
    true = env.reset()
    for _ in range(HORIZON):
        true, gained = env.step(policy(env.known(true)))
        true_return += float(gained.mean())
        places = env.places()
        hit += float((torch.cdist(places, places) + torch.eye(N) < 0.3).any(-1).double().mean())
        if env.team is not None:
            errors.append(float(env.team.error.mean()))
    apart = true[:, :, 4:10].unflatten(-1, (N, 2)).norm(dim=-1)  # [B, N, landmarks]
    success = float((apart.amin(1) < 0.1).all(-1).double().mean())
    found = {"return": true_return, "collisions": hit, "success": success}
    return found | ({"error": float(np.mean(errors))} if errors else {})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=6, help="of 100 episodes each")
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    results: list[dict[str, Any]] = []

    def run(policy: Policy, seed: int, taught: str) -> None:
        for quality in QUALITIES:
            found = measured(policy, quality)
            results.append({"seed": seed, "trained_on": taught, "run_on": quality, **found})
            print(f"  on {quality}: {found}", flush=True)
        if chosen.out:
            chosen.out.write_text(json.dumps(results, indent=1))

    print("the controller")
    run(controller, 0, "controller")
    for seed in range(chosen.seeds):
        for taught in TRAINED_ON:
            start = time.process_time()
            policy = trained(taught, seed, chosen.rounds)
            print(f"seed {seed}, trained on {taught}: {time.process_time() - start:.0f} s of CPU")
            run(policy, seed, taught)


if __name__ == "__main__":
    main()
