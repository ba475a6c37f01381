"""Exchange of raw measurements: everybody runs the joint filter on what has reached it.

What a UAV senses in a step is a packet with its stamp. Packets flood: beside its own, each UAV
sends every packet that somebody it hears has not got. A packet that is late is used where it
belongs, by running the filter again from the last belief to which nothing was missing. Without loss
and delay every UAV's estimate is that of ``ekf_joint``.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float, Float32, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.kalman.ekf_joint import JointEkf
from agents.kalman.filter import GaussianBelief
from agents.kalman.late import chosen
from agents.kalman.log import SensedLog
from agents.localizer import Estimate, Localizer
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.scenario import Believed

_WINDOW = 12  # steps that a packet is waited for, beside its messages' delays
_NUMBER, _INDEX = 4, 1  # bytes of a number, and of which landmark, anchor or UAV it is about


class ExchangeBelief(TensorClass):
    """Each UAV's belief in the whole team, batch (B, N); packets are those of UAV o at the last W
    steps, the newest last.

    ``team``: the joint filter's belief at the last step to which no packet was missing, ``lag``
    steps ago; ``state`` and ``covariance``: the UAV's own, now. ``sensed``: the UAV's own packets.
    ``known``: packets that have arrived. ``reported``: what the UAVs knew at the ends of the last
    steps that messages take, and ``sent``: the packets that they sent in these, the oldest first.
    ``gone``: UAVs that were waited for in vain, and are left out for good. ``bytes`` sent in the
    last step.
    """

    team: GaussianBelief
    lag: Int64[Tensor, "B N"]
    state: Float[Tensor, "B N S"]
    covariance: Float[Tensor, "B N E E"]
    sensed: Float32[Tensor, "B N W F"]
    known: Bool[Tensor, "B N N W"]
    reported: Bool[Tensor, "B N D N W"]
    sent: Bool[Tensor, "B N D N W"]
    gone: Bool[Tensor, "B N N"]
    bytes_sent: Float[Tensor, "B N"]
    step: Int64[Tensor, "B N"]


class ExchangingEkf(Localizer[ExchangeBelief]):
    """``ekf:fusion=exchange``; options as ``ekf_joint`` has them."""

    name = "ekf"

    def __init__(self, believed: Believed, **options: Any) -> None:
        super().__init__(believed)
        self.joint, self.log = JointEkf(believed, **options), SensedLog(believed)
        self.process, self.delay = self.joint.process, believed.message_delay
        self.window = _WINDOW + 2 * self.delay

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> ExchangeBelief:
        x, covariance = self.process.initial(observation["prior"].double())
        n = x.shape[1]
        team = self.joint.reset(observation).unsqueeze(1).expand(len(x), n, n).clone()
        diagonal = torch.eye(n, dtype=torch.float64, device=x.device)[:, None, :, None]
        blocks = covariance[:, :, None, :, None, :] * diagonal
        team.state = x.unsqueeze(2).repeat(1, 1, n, 1)  # until others are heard of: like oneself
        team.covariance = blocks.flatten(-2)
        packets = torch.zeros(*x.shape[:2], n, self.window, dtype=torch.bool, device=x.device)
        waiting = packets.unsqueeze(2).repeat(1, 1, self.delay + 1, 1, 1)
        step = torch.zeros(x.shape[:2], dtype=torch.int64, device=x.device)
        return ExchangeBelief(
            team=team,
            lag=step,
            state=x,
            covariance=covariance,
            sensed=self.log.empty(observation, self.window),
            known=packets,
            reported=waiting,
            sent=waiting,
            gone=packets[..., 0],
            bytes_sent=x[..., 0] * 0,
            step=step,
            batch_size=step.shape,
        )

    def step(
        self, belief: ExchangeBelief, observation: Observation
    ) -> tuple[ExchangeBelief, Estimate]:
        log = self.log.appended(belief.sensed, observation)
        known, sent, reported = self._flooded(belief, log, observation)
        full = belief.lag == self.window - 1
        gone = belief.gone | (full.unsqueeze(-1) & ~known[..., 0])
        heard = _unbroken(known, belief.lag) & ~gone.unsqueeze(-1)
        settled = _unbroken(known | gone.unsqueeze(-1), belief.lag).all(2)
        team, live, estimate = self._run(belief, observation, log, heard, settled)
        lag = (~settled).sum(-1)
        own = torch.arange(lag.shape[1], device=lag.device)
        e = self.process.error_size
        rows = live.covariance[:, own, own].unflatten(-1, (-1, e))  # [B, N, E, N, E]
        after = build(
            ExchangeBelief,
            lag.shape,
            team=team,
            lag=lag,
            state=live.state[:, own, own],
            covariance=rows[:, own, :, own].movedim(0, 1),
            sensed=log,
            known=known,
            reported=reported,
            sent=sent,
            gone=gone,
            bytes_sent=self._bytes(log, sent[:, :, -1]),
            step=belief.step + 1,
        )
        return after, estimate

    def mean(self, belief: ExchangeBelief) -> Float[Tensor, "B N S"]:
        return belief.state

    def gaussian(
        self, belief: ExchangeBelief, observation: Observation
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        return belief.state, belief.covariance

    def diagnostics(self, belief: ExchangeBelief) -> dict[str, Float[Tensor, "B N"]]:
        """``bytes`` that each UAV sent in the step, and how many ``steps_back`` its filter had to
        go."""
        return {"bytes": belief.bytes_sent, "steps_back": belief.lag.to(torch.float32)}

    def _flooded(
        self,
        belief: ExchangeBelief,
        log: Float32[Tensor, "B N W F"],
        observation: Observation,
    ) -> tuple[Bool[Tensor, "B N N W"], Bool[Tensor, "B N D N W"], Bool[Tensor, "B N D N W"]]:
        """Packets known after the step's messages, sent in the last steps, and what was known at
        the ends of the last steps, all with windows that end now."""
        known, sent, reported = (_older(x) for x in (belief.known, belief.sent, belief.reported))
        n, links = known.shape[1], observation["links"] > 0
        eye = torch.eye(n, dtype=torch.bool, device=known.device)
        sane = log.isfinite().all(-1).unsqueeze(1)  # others are spared what is no number
        fresh = torch.zeros_like(known)
        fresh[..., -1] = eye
        # What those that are heard had not got when they sent what is heard now; whether they have
        # got the newest packets, nobody can know yet.
        lacked = (links[..., None, None] & ~reported[:, :, 0].unsqueeze(1)).any(2)
        lacked[..., known.shape[-1] - 1 - 2 * self.delay :] = False
        relayed = known & lacked
        sent = torch.cat((sent[:, :, 1:], ((fresh | relayed) & sane).unsqueeze(2)), 2)
        arrived = (links[..., None, None] & sent[:, :, 0].unsqueeze(1)).any(2)
        known = known | arrived
        known[..., -1] |= eye  # one's own, whatever it holds
        return known, sent, torch.cat((reported[:, :, 1:], known.unsqueeze(2)), 2)

    def _run(
        self,
        belief: ExchangeBelief,
        observation: Observation,
        log: Float32[Tensor, "B N W F"],
        heard: Bool[Tensor, "B N N W"],
        settled: Bool[Tensor, "B N W"],
    ) -> tuple[GaussianBelief, GaussianBelief, Estimate]:
        """The joint filters run from where nothing was missing: their beliefs after the last step
        to which nothing is missing now, and after this one, and each UAV's estimate."""
        b, n = belief.lag.shape
        alike = bool(heard.all()) and not bool(belief.gone.any()) and not bool(belief.lag.any())
        owners = 1 if alike else n  # as long as nothing was missing, one stands for all
        live = self._started(belief, observation, heard)[:, :owners].flatten(0, 1)
        lag = belief.lag[:, :owners].flatten()
        team, estimate = live, None
        for age in range(int(lag.max()), -1, -1):
            seen = self._view(observation, log[..., -1 - age, :], heard[:, :owners, :, -1 - age])
            then, estimate = self.joint.step(live, seen)
            live = chosen(lag >= age, then, live)
            known = settled[:, :owners, -1 - age].flatten()
            team = chosen((lag >= age) & known, then, team)
        assert estimate is not None
        own = torch.arange(n, device=lag.device)
        each = estimate.unflatten(0, (b, owners)).expand(b, n, n)[:, own, own]
        team, live = (x.unflatten(0, (b, owners)).expand(b, n, n) for x in (team, live))
        return team, live, each

    def _started(
        self, belief: ExchangeBelief, observation: Observation, heard: Bool[Tensor, "B N N W"]
    ) -> GaussianBelief:
        """The belief in the team; where it is from before the first step, with the priors of those
        whose first packet has arrived."""
        team = belief.team
        if bool((team.step > 0).all()):
            return team
        start = self.joint.reset(observation)
        first = (self.window - 1 - belief.lag)[..., None, None].expand(*heard.shape[:3], 1)
        known = heard.gather(3, first) & (team.step == 0).unsqueeze(-1)
        return team.replace(
            state=torch.where(known, start.state.unsqueeze(1), team.state),
            covariance=torch.where(
                known.unsqueeze(-1), start.covariance.unsqueeze(1), team.covariance
            ),
        )

    def _view(
        self,
        observation: Observation,
        row: Float32[Tensor, "B N F"],
        heard: Bool[Tensor, "B O N"],
    ) -> Observation:
        """What O UAVs of each world know of what the team sensed in a step, as B · O worlds."""
        owners = heard.shape[1]

        def wide(leaf: Float32[Tensor, "B N W"]) -> Float32[Tensor, "B*O N W"]:
            return leaf.unsqueeze(1).expand(-1, owners, -1, -1).flatten(0, 1)

        there = heard.flatten(0, 1).unsqueeze(-1)
        row = torch.where(there, wide(row), 0.0)
        leaves = {
            name: wide(leaf)
            for name, leaf in observation.leaves.items()
            if name not in self.log.widths and not name.startswith("message")
        }
        leaves |= self.log.leaves(row)
        return Observation(leaves if bool(there.all()) else leaves | {"heard": there.float()})

    def _bytes(
        self, log: Float32[Tensor, "B N W F"], sent: Bool[Tensor, "B N N W"]
    ) -> Float[Tensor, "B N"]:
        """Bytes of the packets sent, and a bit for each packet that the sender has got or not."""
        leaves, widths = self.log.leaves(log), self.log.widths
        size = torch.zeros_like(log[..., 0])
        for mask, value in self.log.values.items():
            each = widths[value] // widths[mask] * _NUMBER + _INDEX
            size = size + each * (leaves[mask] > 0).sum(-1)
        measured = {*self.log.values, *self.log.values.values(), "links"}
        size = size + _NUMBER * sum(width for name, width in widths.items() if name not in measured)
        packets = sent.shape[2] * sent.shape[3]
        return (sent * size.unsqueeze(1)).sum((-2, -1)).double() + -(-packets // 8)


def _older(packets: Bool[Tensor, "*s W"]) -> Bool[Tensor, "*s W"]:
    """The same a step later, before anything is known of the new step."""
    return torch.cat((packets[..., 1:], torch.zeros_like(packets[..., :1])), -1)


def _before(lag: Int64[Tensor, "B N"], steps: int) -> Bool[Tensor, "B N 1 W"]:
    """Which of the last steps have been used for good."""
    index = torch.arange(steps, device=lag.device)
    return (index < steps - 1 - lag.unsqueeze(-1)).unsqueeze(-2)


def _unbroken(known: Bool[Tensor, "B N N W"], lag: Int64[Tensor, "B N"]) -> Bool[Tensor, "B N N W"]:
    """Which packets are known together with all before them that are not used for good."""
    there = known | _before(lag, known.shape[-1])
    return there.to(torch.int8).cumprod(-1) > 0
