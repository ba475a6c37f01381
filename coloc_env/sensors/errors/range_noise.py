"""What a UWB range reads for a true distance: noise, bias, outliers and losses."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.options import Group, Metres, PositiveMetres, PositiveSeconds, Seconds, Share
from coloc_env.sensors.base import Window, require
from coloc_env.sensors.errors.persistence import gauss_markov, held_uniform

NlosKind = Literal["exponential", "constant"]
OutageOf = Literal["link", "team"]


@dataclass(frozen=True)
class RangeNoise:
    """Range = distance + noise, every number drawn from the link's own key.

    - ``std``: Gaussian standard deviation in m; with probability ``tail`` it is ``tail_std``
      instead (a heavy-tail mixture);
    - ``uniform``: half width in m of an added uniform error;
    - ``nlos``: probability, per link and step, of a positive bias: exponential with mean
      ``nlos_bias`` m (``nlos_kind="exponential"``) or exactly that (``"constant"``);
    - ``nlos_time``: seconds over which a link is in sight or not, a two-state Markov chain whose
      correlation falls by e in that time (None: every step for itself); the size of an exponential
      bias is drawn for every step in any case;
    - ``impulse``: probability of a gross error, uniform within ±``impulse_size`` m;
    - ``dropout``: probability that no range arrives;
    - ``per_metre``: what each metre of distance adds to ``std``, in m;
    - ``bias_std``: standard deviation in m of each link's bias, a Gauss–Markov process whose
      correlation falls by e in ``bias_time`` s;
    - ``outage``: share of the time in which no range arrives, ``outage_time`` s at a stretch (a
      state, out or not, is redrawn at a mean interval of so long), of each link for itself
      (``outage_of="link"``) or of all links at once (``"team"``); and none in the times ``off``
      (from, to) in s.
    """

    std: float = 0.2
    nlos: float = 0.0
    nlos_bias: float = 1.0
    nlos_kind: NlosKind = "exponential"
    tail: float = 0.0
    tail_std: float = 1.0
    uniform: float = 0.0
    impulse: float = 0.0
    impulse_size: float = 10.0
    dropout: float = 0.0
    nlos_time: float | None = None
    per_metre: float = 0.0
    bias_std: float = 0.0
    bias_time: float = 100.0
    outage: float = 0.0
    outage_time: float = 5.0
    outage_of: OutageOf = "link"
    off: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name in ("nlos", "tail", "impulse", "dropout", "outage"):
            require(0 <= getattr(self, name) <= 1, self, name, "a probability in [0, 1]")
        sizes = ("std", "nlos_bias", "tail_std", "uniform", "impulse_size", "per_metre", "bias_std")
        for name in sizes:
            require(0 <= getattr(self, name) < math.inf, self, name, "a size in m ≥ 0")
        require(0 < self.bias_time < math.inf, self, "bias_time", "a time in s > 0")
        kinds = get_args(NlosKind)
        require(self.nlos_kind in kinds, self, "nlos_kind", f"one of {', '.join(kinds)}")
        lasting = self.nlos_time is None or 0 < self.nlos_time < math.inf
        require(lasting, self, "nlos_time", "a time in s > 0")
        require(0 < self.outage_time < math.inf, self, "outage_time", "a time in s > 0")
        of = get_args(OutageOf)
        require(self.outage_of in of, self, "outage_of", f"one of {', '.join(of)}")
        ordered = self.off is None or self.off[0] <= self.off[1]
        require(ordered, self, "off", "(from, to) in s, from ≤ to")

    def out(
        self, window: Window, links: Int64[Tensor, "*l"], stream: str, latency: int = 0
    ) -> Bool[Tensor, "R K *l"] | None:
        """Which of the numbered links are in an outage, ``latency`` steps before each of the
        window's; None where none ever is. One of the team is the same for ranges of all kinds."""
        if not self.outage and self.off is None:
            return None
        dt, found = window.layout.arena.dt, None
        steps = window.steps - latency
        if self.outage:
            whose, name = links, f"{stream}.outage"
            if self.outage_of == "team":
                whose, name = torch.zeros_like(links.flatten()[:1]), "uwb.outage"
            time = self.outage_time / dt
            drawn = held_uniform(window.rows, steps[:, 0], steps.shape[1], whose, name, time)
            found = drawn < self.outage
            if self.outage_of == "team":
                found = found.view(*steps.shape, *(1,) * links.dim())
            found = found.expand(*steps.shape, *links.shape)
        if self.off is not None:
            now = steps * dt
            none = (now >= self.off[0]) & (now < self.off[1])
            none = none.view(*steps.shape, *(1,) * links.dim()).expand(*steps.shape, *links.shape)
            found = none if found is None else found | none
        return found

    def obstructed(
        self, window: Window, links: Int64[Tensor, "*l"], stream: str, latency: int = 0
    ) -> Bool[Tensor, "R K *l"] | None:
        """Which of the numbered links are NLOS, ``latency`` steps before each of the window's; None
        where every step is for itself."""
        if self.nlos_time is None:
            return None
        first, count = window.steps[:, 0] - latency, window.steps.shape[1]
        time = self.nlos_time / window.layout.arena.dt
        return held_uniform(window.rows, first, count, links, f"{stream}.nlos", time) < self.nlos

    def biases(
        self, window: Window, links: Int64[Tensor, "*l"], stream: str, latency: int = 0
    ) -> Float32[Tensor, "R K *l"] | None:
        """Biases (m) of the numbered links, ``latency`` steps before each of the window's; None
        where there are none."""
        if not self.bias_std:
            return None
        first, count = window.steps[:, 0] - latency, window.steps.shape[1]
        time = self.bias_time / window.layout.arena.dt
        drawn = gauss_markov(window.rows, first, count, links, f"{stream}.bias", time)
        return self.bias_std * drawn

    def sample(
        self,
        distance: Float32[Tensor, "*s"],
        keys: Int64[Tensor, "*s"],
        stream: str,
        blocked: Bool[Tensor, "*#s"] | None = None,
        obstructed: Bool[Tensor, "*#s"] | None = None,
    ) -> tuple[Float32[Tensor, "*s"], Bool[Tensor, "*s"] | None]:
        """Ranges in m and which of them were lost (None: none can be); the bias of ``nlos`` always
        strikes links that are ``blocked``, and otherwise those ``obstructed`` (None: by chance)."""

        def chance(probability: float, name: str) -> Tensor:
            return noise.uniform(keys, f"{stream}.{name}", 1)[..., 0] < probability

        def draw(name: str) -> Tensor:
            return noise.uniform(keys, f"{stream}.{name}", 1)[..., 0]

        error = noise.normal(keys, stream, 1)[..., 0]
        if self.tail:
            wide, narrow = error.new_tensor((self.tail_std, self.std))
            spread = narrow + self.per_metre * distance if self.per_metre else narrow
            error = error * torch.where(chance(self.tail, "tail"), wide, spread)
        elif self.per_metre:
            error = error * (self.std + self.per_metre * distance)
        else:
            error = error * self.std
        if self.uniform:
            error = error + (2 * draw("uniform") - 1) * self.uniform
        if self.nlos or blocked is not None:
            size = torch.full_like(error, self.nlos_bias)
            if self.nlos_kind == "exponential":
                size = size * -draw("nlos.size").log()
            if self.nlos or blocked is None:
                late = chance(self.nlos, "nlos") if obstructed is None else obstructed
                late = late if blocked is None else late | blocked
            else:
                late = blocked
            error = error + torch.where(late, size, 0.0)
        if self.impulse:
            size = (2 * draw("impulse.size") - 1) * self.impulse_size
            error = error + torch.where(chance(self.impulse, "impulse"), size, 0.0)
        lost = chance(self.dropout, "dropout") if self.dropout else None
        return error.add_(distance), lost


@dataclass(frozen=True)
class RangeOptions(Group):
    """Ranges are N(d, σ²), σ ``uwb_std`` m and ``uwb_std_per_metre`` m more for each metre; a share
    ``nlos`` of them has a bias of ``nlos_bias`` m (``nlos_kind``: on average, or exactly), in each
    step by chance or over ``nlos_time`` s; a share ``uwb_tail`` has noise of ``uwb_tail_std`` m
    instead; ``uwb_uniform`` m is the half width of a uniform error; a share ``uwb_impulse`` is off
    by up to ``uwb_impulse_size`` m, and a share ``uwb_dropout`` is missing. Each link's ranges have
    a bias of ``range_bias_std`` m that lasts ``range_bias_time`` s (a Gauss–Markov process). There
    are none for a share ``uwb_outage`` of the time, ``uwb_outage_time`` s at a stretch, of each
    ``link`` for itself or of the whole ``team`` (``uwb_outage_of``), and none in the times
    ``uwb_off`` (from, to). The team believes the Gaussian parts alone, with ``believed_uwb_std`` m
    for ``uwb_std`` (none: the true one, where the scenario does not say otherwise).
    """

    title: ClassVar[str] = "UWB ranges"

    uwb_std: Metres = 0.2
    uwb_std_per_metre: Metres = 0.0
    nlos: Share = 0.0
    nlos_bias: Metres = 1.0
    nlos_kind: NlosKind = "exponential"
    nlos_time: PositiveSeconds | None = None
    uwb_tail: Share = 0.0
    uwb_tail_std: Metres = 1.0
    uwb_uniform: Metres = 0.0
    uwb_impulse: Share = 0.0
    uwb_impulse_size: Metres = 10.0
    uwb_dropout: Share = 0.0
    range_bias_std: Metres = 0.0
    range_bias_time: PositiveSeconds = 100.0
    uwb_outage: Share = 0.0
    uwb_outage_time: PositiveSeconds = 5.0
    uwb_outage_of: OutageOf = "link"
    uwb_off: tuple[Seconds, Seconds] | None = None
    believed_uwb_std: PositiveMetres | None = None

    @property
    def true(self) -> RangeNoise:
        """The noise that ranges have."""
        return RangeNoise(
            std=self.uwb_std,
            per_metre=self.uwb_std_per_metre,
            nlos=self.nlos,
            nlos_bias=self.nlos_bias,
            nlos_kind=self.nlos_kind,
            nlos_time=self.nlos_time,
            tail=self.uwb_tail,
            tail_std=self.uwb_tail_std,
            uniform=self.uwb_uniform,
            impulse=self.uwb_impulse,
            impulse_size=self.uwb_impulse_size,
            dropout=self.uwb_dropout,
            bias_std=self.range_bias_std,
            bias_time=self.range_bias_time,
            outage=self.uwb_outage,
            outage_time=self.uwb_outage_time,
            outage_of=self.uwb_outage_of,
            off=self.uwb_off,
        )

    @property
    def believed(self) -> RangeNoise:
        """The noise that the team believes in."""
        std = self.uwb_std if self.believed_uwb_std is None else self.believed_uwb_std
        return RangeNoise(
            std,
            per_metre=self.uwb_std_per_metre,
            bias_std=self.range_bias_std,
            bias_time=self.range_bias_time,
        )
