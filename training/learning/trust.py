"""Training of the trust networks, by truncated backpropagation through a differentiable EKF."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from agents import make
from agents.bank import BankBelief, learned_branch
from agents.kalman.ekf import CooperativeEkf
from agents.kalman.filter import GaussianBelief
from agents.policies.adapters import LocalizerPolicy
from agents.robust import Capped
from agents.trust import TrustNetwork
from agents.weights import learned, untrained
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.motion.recorded import RecordedMotion
from coloc_env.observation import Observation, all_leaves
from coloc_env.options import Factor
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario, parse_scenario
from coloc_env.sensors import Landmarks, Ranging
from training.learning.collectors import (
    EpochCollector,
    Epochs,
    RoundRobin,
    ScoreRuns,
    Seed,
    Steps,
    Worlds,
    episode_collector,
    require_batches,
    world_seed,
)
from training.learning.comparison import compared
from training.learning.labels import Labels, smoothed
from training.learning.left_out import Watched
from training.learning.run import Progress, Training, make_trainer
from training.learning.through_time import negative_log_likelihood

# What the networks meet: each difficulty alone, all at once, nothing at all; and ranges unlike
# those of the room: to anchors alone, by a motion model without IMU, with gross errors both ways,
# heavy tails, drop-outs, and noise that the team is wrong about.
VARIANTS = (
    "",
    "nlos=0.3",
    "nlos=0.15:nlos_bias=0.5:motion=random",
    "nlos=0.3:range_only=5,25:horizon=300",
    "false_matches=0.1",
    "prior=uniform:nlos=0.3:false_matches=0.1:landmark_dropout=0.5:motion=random",
    "landmarks=5:nlos=0.3:horizon=300",
    "landmarks=5:nlos=0.3:false_matches=0.1:horizon=300",
    "landmarks=5:nlos=0.5:false_matches=0.2:motion=random",
    "prior=uniform:landmarks=5:nlos=0.3:false_matches=0.1:landmark_dropout=0.5:horizon=200",
    "landmarks=0:anchors=4:uwb=false:imu=false:uwb_impulse=0.01:uwb_std=0.1:believed_uwb_std=0.2"
    ":uwb_dropout=0.1",
    "landmarks=0:anchors=6:nlos=0.2:nlos_time=5:uwb_tail=0.05:uwb_dropout=0.3",
    "landmarks=0:anchors=4:uwb_impulse=0.02:uwb_std=0.3:believed_uwb_std=0.2:motion=random",
    "landmarks=5:uwb_tail=0.1:uwb_impulse=0.01:believed_uwb_std=0.15:uwb_dropout=0.2:horizon=200",
)
SCORED = ("", "nlos=0.3", "false_matches=0.1", "landmarks=5:nlos=0.3:false_matches=0.1")
LabelName = Literal["truth", "left_out", "self_supervised"]


class TrustLoss(LossModule):
    """Mean negative log-likelihood over a batch's steps: of the positions, true ones or
    ``self_supervised`` labels; or (``left_out``) of all that was measured, each left out.

    The EKF is run again over the batch [B, T], from the belief that its first step started
    from and on the observations that were made, this time with gradients: truncated backpropagation
    through time. Neighbours' messages are taken as they were received.
    """

    in_keys = ["uav", "state", "train"]  # noqa: RUF012
    out_keys = ["loss_trust"]  # noqa: RUF012

    def __init__(
        self,
        network: TrustNetwork,
        filters: Sequence[CooperativeEkf],
        scenarios: Sequence[Scenario],
        labels: LabelName = "truth",
    ) -> None:
        super().__init__()
        self.network, self.labels = network, labels
        self.filters, self.scenarios = tuple(filters), tuple(scenarios)

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        train = tensordict["train"]
        variant = int(train["variant"][0, 0])
        ekf, scenario = self.filters[variant], self.scenarios[variant]
        if self.labels == "truth":
            state = tensordict["state"].unflatten(-1, (scenario.arena.n_uavs, -1)).double()
            where, scored = state[..., : scenario.arena.dim], state[..., -1] > 0
        elif self.labels == "self_supervised":
            where, scored = train["label"], train["known"] & tensordict["uav", "mask"]
        else:
            where, scored = None, tensordict["uav", "mask"]
        belief = _belief(train[:, 0])
        losses, counts = [], []
        for t in range(tensordict.shape[1]):
            seen = tensordict["uav", "observation"][:, t]
            observation = Observation({name: seen[name] for name in all_leaves(scenario)})
            belief, estimate = ekf.step(belief, observation)
            if where is None:
                assert isinstance(ekf.screen, Watched)
                loss, count = ekf.screen.surprise(belief.covariance)
            else:
                offset = estimate.position - where[:, t]
                loss = negative_log_likelihood(offset, estimate.covariance)
                count = torch.ones_like(loss)
            losses.append(torch.where(scored[:, t], loss, 0.0))
            counts.append(torch.where(scored[:, t], count, 0.0))
        total = torch.stack(losses).sum() / torch.stack(counts).sum().clamp_min(1)
        return TensorDict({"loss_trust": total})


def _record(
    variant: int,
    before: Any,
    after: Any,
    tensordict: TensorDictBase,
    labels: Labels | None = None,
) -> dict[str, Tensor]:
    """The belief that the learned filter's step starts from, which scenario it is of, and its
    labels if there are any."""
    if isinstance(before, BankBelief):
        before = learned_branch(before)
    own: dict[str, Tensor] = {}
    if labels is not None:
        own["label"], own["known"] = labels.at(int(before.step.flatten()[0]))
    return {
        **own,
        "state": before.state,
        "covariance": before.covariance,
        "considered": before.considered,
        "shared": before.shared,
        "step": before.step,
        "memory": before.memory,
        "variant": torch.full_like(before.step[:, 0], variant),
    }


def _belief(entries: TensorDictBase) -> GaussianBelief:
    names = ("state", "covariance", "considered", "shared", "step", "memory")
    parts = {name: entries[name] for name in names}
    return GaussianBelief(**parts, batch_size=parts["step"].shape)


def trust(
    device: str = "cpu",
    *,
    scenario: str = "indoor-v0:horizon=100",
    variants: str | None = None,
    labels: LabelName = "truth",
    start: str = "trust",
    worlds: Worlds = 8,
    epochs: Epochs = 6,
    steps: Steps = 10,
    learning_rate: Factor = 1e-3,
    seed: Seed = 0,
    score_runs: ScoreRuns = 10,
) -> Training:
    """The trust networks of ``ekf_trust`` and ``pf_trust``, through a differentiable EKF whose
    weights are the least of theirs and Huber's.

    In each of ``epochs`` epochs ``worlds`` new worlds of every variant of ``scenario`` (clean,
    NLOS, false matches, few landmarks, uniform prior, anchors alone, ranges unlike what is
    believed, combinations) are run with the newest weights, in turn by the filter alone and by its
    bank; every ``steps`` steps the position's negative log-likelihood is backpropagated through
    the learned filter. ``variants``: overrides of ``scenario``, separated by slashes (none: those
    above; a recording as it is). The learning rate falls linearly to a twentieth. ``start``: the
    checkpoint whose weights it starts from, by name or path (``none``: random ones).

    ``labels``: the ``truth``; or, without any truth, ``left_out``, the likelihood of each
    measurement predicted by all others and the past in place of the position's, or
    ``self_supervised``, that of positions in ``dfgo``'s smoothed window a second later, UAVs tied
    by landmarks that they see in common.

    ``score_runs``: held-out worlds on which ``ekf_trust`` is compared to a Huber EKF at the end
    (none on a recording).
    """
    recorded = isinstance(parse_scenario(scenario).motion, RecordedMotion)
    chosen: Sequence[str] = ("",) if recorded else VARIANTS
    if variants is not None:
        chosen = variants.split("/")
    scenarios = [parse_scenario(scenario, variant) for variant in chosen]
    require_batches("trust", scenarios, steps)
    network = _first(start, seed).to(device)
    filters: list[Any] = [make("ekf_trust:bank=false:weights=none", one) for one in scenarios]
    banks: list[Any] = [make("ekf_trust:weights=none", one) for one in scenarios]
    for ekf, bank in zip(filters, banks, strict=True):
        ekf.learn(network)
        ekf.screen = Watched(Capped(ekf.screen))
        bank.learn(network)
        ekf.to(device)
        bank.to(device)
    loss = TrustLoss(network, filters, scenarios, labels)
    optimizer = torch.optim.Adam(loss.parameters(), learning_rate)

    def collect(epoch: int) -> RoundRobin:
        share = 1 - 0.95 * epoch / max(1, epochs - 1)
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * share
        first = world_seed(seed, epoch, worlds * len(scenarios))
        collectors = []
        team = banks if epoch % 2 else filters
        for i, (one, localizer) in enumerate(zip(scenarios, team, strict=True)):
            known = None
            if labels == "self_supervised":
                known = smoothed(one, worlds, first + i * worlds, device)
            env = CoLocEnv(one, worlds, device, seed=first + i * worlds)
            record_belief = partial(_record, i, labels=known)
            policy = LocalizerPolicy(localizer, one, record=record_belief)
            # ("next", "uav", "observation") is the next step's: half the memory.
            collectors.append(episode_collector(env, policy, steps, compact_obs=True))
        return RoundRobin(collectors)

    collector = EpochCollector(collect, epochs)
    trainer = make_trainer(collector, loss, optimizer, clip_norm=1.0)
    return Training(
        module=network,
        collector=collector,
        trainer=trainer,
        score=partial(score, network, scenario.split(":")[0], 0 if recorded else score_runs),
    )


def _first(start: str, seed: int) -> TrustNetwork:
    """The networks before training, with features free of units."""
    if start == "none":
        return untrained(TrustNetwork, seed, relative=True)
    known = learned(TrustNetwork, start)
    room = make_scenario("indoor-v0").believed
    vectors, ranges = room.sensor(Landmarks), room.sensor(Ranging)
    assert vectors is not None
    assert ranges is not None
    if known.relative:
        return known
    return TrustNetwork.relative_to(known, vectors.std, ranges.noise.std)


def score(network: TrustNetwork, base: str, runs: int, progress: Progress) -> Mapping[str, Any]:
    """RMSE (m) of ``ekf_trust`` and of a Huber EKF over 300 steps of the worlds of seeds
    0 … runs − 1 in some variants."""

    def build(variant: str) -> Scenario:
        return parse_scenario(base, f"horizon=300:{variant}".rstrip(":"))

    def agents(scenario: Scenario) -> dict[str, Any]:
        ours: Any = make("ekf_trust:weights=none", scenario)
        ours.learn(network)
        return {"ekf_trust": ours, "ekf_huber": make("ekf:robust=huber", scenario)}

    return compared(SCORED, build, agents, runs, progress, steps=300)
