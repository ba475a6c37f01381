"""What policies learn in the environment, beside the filters and the bound. No paper."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coloc_env.render.style import INK, MUTED
from training.evaluation import metrics
from training.evaluation.metrics import Difference, Floats
from training.evaluation.tables import short
from training.reproduce.drawing import panels
from training.reproduce.marl.plan import FILTERS, Plan, Target, plan
from training.reproduce.measures import mean_error
from training.reproduce.results import Results, Runs
from training.reproduce.settings import Settings
from training.reproduce.study import Part, Study
from training.reproduce.tables import Table
from training.reproduce.verdicts import Goal, gain
from training.reproduce.work import WORLD, Cell, Training

SETTLED = 10.0  # s after which a run has settled
_ACROSS = 4  # panels side by side
_BATCHES = 8  # of 25 steps, in an epoch of 200
_LINES = {  # of the filters
    "ekf": (MUTED, ":"),
    "ekf:robust=huber": (MUTED, "--"),
    "ekf_trust": ("#009E73", "-."),
    "pf_trust": ("#D55E00", "-."),
}
_OWN = "#0072B2"
_TRIED = {"mixed": "default", "huber-nlos": "nlos", "huber-uwb": "uwb", "displacement": "default"}


def marl() -> Study:
    """MARL: corrections that multi-agent PPO learns on filters that believe something wrong, five
    seeds each, in worlds that nothing was trained on."""
    return study_of(plan())


def study_of(the: Plan) -> Study:
    """The study of a plan."""
    own = _Report(the)
    part = Part(
        "Policies beside filters",
        own.cells,
        own.text,
        goals=own.goals,
        tables=own.tables,
        figures={"curves.png": own.curves},
        trainings=own.trainings,
    )
    source = "Policies that learn in the environment, beside the filters and the bound"
    return Study("marl", "MARL", source, 40, {"policies": part})


@dataclass(frozen=True)
class _Errors:
    """An agent's mean error in each run (m), and RMSE after 10 s (m); of a policy the mean over its
    training seeds, and the range of their means."""

    runs: tuple[Runs, ...]

    @cached_property
    def per_run(self) -> Floats:
        return np.mean([mean_error(one) for one in self.runs], 0)

    @property
    def steady(self) -> float:
        every = [metrics.rmse_after(x.error, x.scored, x.dt, SETTLED) for x in self.runs]
        return float(np.mean(every))

    @property
    def mean(self) -> float:
        return float(self.per_run.mean())

    @property
    def over_seeds(self) -> tuple[float, float]:
        means = [float(mean_error(one).mean()) for one in self.runs]
        return min(means), max(means)

    def cell(self, best: float) -> str:
        """As it stands in the table; the best of a line bold."""
        text = short(self.mean)
        if math.isclose(self.mean, best):
            text = f"**{text}**"
        low, high = self.over_seeds
        if high > low:
            text += f" [{short(low)}–{short(high)}]"
        return f"{text}; {short(self.steady)}"


@dataclass(frozen=True)
class _Report:
    """What the study's parts are, of a plan."""

    the: Plan

    def _asked(self, settings: Settings) -> set[str]:
        """Policies tried in the variants asked for."""
        names = settings.variants
        worlds = [keys for v, keys in self.the.worlds if names is None or v.key in names]
        return {key for keys in worlds for key in keys}

    def _agents(self, settings: Settings, key: str) -> tuple[str, ...]:
        (policy,) = (policy for policy in self.the.policies if policy.key == key)
        return policy.agents(settings.out, self.the.seeds)

    def cells(self, settings: Settings) -> Iterator[Cell]:
        for variant, policies in self.the.worlds:
            learned = (agent for key in policies for agent in self._agents(settings, key))
            yield Cell(variant, (*FILTERS, *learned), settings.runs)

    def trainings(self, settings: Settings) -> Iterator[Training]:
        asked = self._asked(settings)
        for policy in self.the.policies:
            if policy.key in asked:
                yield from policy.runs(self.the.seeds)

    def text(self, settings: Settings) -> list[str]:
        return [
            f"{settings.runs} worlds of 20 s with motion, landmarks and seeds that nothing was "
            "trained on.",
            "Errors are means over UAVs, steps and runs, in m, of which the policies' reward is "
            "made; RMSE after 10 s beside them. A policy's figure is the mean over its training "
            "seeds, the range over them in brackets. Goals: by how many per cent the mean error is "
            "below the rival's, with the 95 % interval of the differences paired by world.",
        ]

    def goals(self, settings: Settings) -> Iterator[Goal]:
        for each in self.the.targets:
            agents = self._agents(settings, each.policy)
            needs = tuple((each.variant, agent) for agent in (each.rival, *agents))
            yield Goal(self._words(each), "%", each.least, True, needs, _less,
                       "mean and sign" if each.clear else "mean")  # fmt: skip

    def _words(self, target: Target) -> str:
        titles = {variant.key: variant.title for variant, _ in self.the.worlds}
        also = ", interval above 0" if target.clear else ""
        return f"{target.policy} in {titles[target.variant]}: less than `{target.rival}`{also}"

    def _found(self, results: Results) -> dict[str, dict[str, _Errors]]:
        """By variant's key, then filter or policy; those whose seeds are all there."""
        found: dict[str, dict[str, _Errors]] = {}
        for variant, policies in self.the.worlds:
            names: dict[str, tuple[str, ...]] = {name: (name,) for name in (WORLD, *FILTERS)}
            names |= {key: self._agents(results.settings, key) for key in policies}
            for name, agents in names.items():
                there = tuple(results.runs(variant.key, agents).values())
                if len(there) == len(agents):
                    found.setdefault(variant.key, {})[name] = _Errors(there)
        return found

    def tables(self, results: Results) -> Iterator[Table]:
        """Variants down; filters, then policies across."""
        found = self._found(results)
        columns = [WORLD, *FILTERS, *(policy.key for policy in self.the.policies)]
        columns = [name for name in columns if any(name in there for there in found.values())]
        rows = []
        for variant, _ in self.the.worlds:
            if there := found.get(variant.key):
                best = min(one.mean for one in there.values())
                cells = [there[x].cell(best) if x in there else "" for x in columns]
                rows.append([variant.title, short(_bound(there)), *cells])
        header = ["variant", "bound (RMSE)", *(f"`{name}`" for name in columns)]
        yield Table("Mean error (m); RMSE after 10 s", header, rows)

    def curves(self, results: Results) -> Figure | None:
        """Mean error in training, exploration included, over agent-steps; a line a training seed.
        Filters, and the bound as an RMSE, over runs of 20 s."""
        out = results.settings.out
        curves = {
            policy: [c for run in policy.runs(self.the.seeds) for c in learning_curve(run, out)]
            for policy in self.the.policies
        }
        shown = {policy: some for policy, some in curves.items() if some}
        if not shown:
            return None
        found, rows = self._found(results), -(-len(shown) // _ACROSS)
        size = (11.5, 0.9 + 2.5 * rows)
        figure, grid = panels(rows, min(_ACROSS, len(shown)), size, "Learning curves")
        every = [axes for row in grid for axes in row]
        for axes in every[len(shown) :]:
            axes.set_visible(False)
        for axes, (policy, some) in zip(every, shown.items(), strict=False):
            for steps, error in some:
                axes.plot(steps / 1e6, error, color=_OWN, linewidth=1.0, alpha=0.55)
            there = found.get(_TRIED.get(policy.key, policy.key), {})
            if policy.key != "mixed":
                for name, (colour, style) in _LINES.items():
                    if name in there:
                        axes.axhline(there[name].mean, color=colour, ls=style, lw=1.2)
                if bound := _bound(there):
                    axes.axhline(bound, color=INK, linewidth=1.2)
                if WORLD in there:
                    words = f"dead reckoning: {there[WORLD].mean:.0f} m"
                    axes.text(0.98, 0.95, words, transform=axes.transAxes, ha="right", va="top",
                              fontsize=8, color=MUTED)  # fmt: skip
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
            axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if _few(value) else "")
            axes.tick_params(axis="y", which="minor", labelsize=8)
            axes.set_title(policy.title, fontsize=8.5, loc="left")
            axes.set_xlim(left=0)
        figure.supxlabel("agent-steps (million)", fontsize=9)
        figure.supylabel("mean error in training (m)", fontsize=9)
        labels = {"training seeds": (_OWN, "-"), **_LINES, "posterior bound (an RMSE)": (INK, "-")}
        handles = [Line2D([], [], color=c, ls=s, label=x) for x, (c, s) in labels.items()]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8.5)
        return figure


def learning_curve(run: Training, out: Path) -> Iterator[tuple[Floats, Floats]]:
    """Agent-steps, and the mean error (m) of every epoch, if the run is there."""
    file = run.folder(out) / "metrics" / "scalars" / "error.csv"
    if file.is_file():
        rows = np.loadtxt(file, delimiter=",", ndmin=2)
        whole = rows[: len(rows) // _BATCHES * _BATCHES].reshape(-1, _BATCHES, 2)
        yield whole[:, -1, 0], whole[..., 1].mean(1)


def _less(rival: Runs, *policies: Runs) -> Difference:
    """By how many per cent a policy's mean error, over its seeds, is below a rival's."""
    return gain(_Errors(policies).per_run, mean_error(rival))


def _bound(there: dict[str, _Errors]) -> float | None:
    bounds = (one.runs[0].evaluation.bound for one in there.values())
    return next((bound.rmse for bound in bounds if bound is not None), None)


def _few(value: float) -> bool:
    """Whether a minor tick is worth a label: twos and fives."""
    return round(value / 10 ** np.floor(np.log10(value))) in (2, 5)
