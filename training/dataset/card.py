"""The card of a dataset, for people."""

from importlib.metadata import version

from coloc_env.scenarios import SCENARIOS
from training.dataset.plan import Column, Plan

_READ = """\
```python
import pyarrow.dataset
from tensordict import TensorDict

table = pyarrow.dataset.dataset("DIR/steps").to_table(columns=["seed", "step", "uav", "{column}"])
runs = TensorDict.load_memmap("DIR/tensordict/part-00000")  # nothing is read before it is used
runs["steps", "truth", "position"]  # [run, step, UAV, axis]
```"""


def card(plan: Plan, whole: bool) -> str:
    """The text of README.md: what was run, how it is laid out, what each column is."""
    scenario, arena = plan.scenario, plan.scenario.arena
    last = plan.seed + plan.runs - 1
    settings = ", ".join(f"{k}={v}" for k, v in plan.facts()["overrides"].items()) or "none"
    who = plan.agent or "nobody: there are no actions, rewards or messages"
    of_steps = [column for column in plan.columns if not column.world]
    of_worlds = [column for column in plan.columns if column.world]
    observed = next(c.title for c in of_steps if c.name[0] == "observation")
    return "\n".join(
        [
            f"# {scenario.name}: {plan.runs} runs",
            "",
            SCENARIOS.summary(scenario.name),
            "" if whole else "\n**Not complete:** the same command goes on with it.\n",
            "| | |",
            "|---|---|",
            f"| scenario | `{scenario.name}`, overrides: {settings} |",
            f"| runs | {plan.runs}, seeded {plan.seed} to {last}: a run is the same whatever else "
            "is run |",
            f"| a run | {plan.steps} steps of {arena.dt:g} s, {arena.n_uavs} UAVs in {arena.dim}-D "
            "|",
            f"| estimates by | {who} |",
            "| frames | world: east, north, up; bodies: forward, left, up; quaternions w, x, y, z, "
            "body to world |",
            f"| written by | coloc-env {version('coloc-env')}: `{plan.command('DIR')}` |",
            "",
            "Step k is sensed at time k; an action is the estimate of the state at the same step. "
            "Entries that a mask marks with 0 were not measured, and are 0. `scored`: where "
            "estimates count; `alive`: UAVs that have not failed.",
            "",
            "## Files",
            "",
            f"- `steps/part-….parquet`: a row for each run, step and UAV; {plan.count} parts, a "
            "run a row group",
            "- `worlds/part-….parquet`: a row for each run and UAV: maps, the prior",
            "- `tensordict/part-…`: the same as memory-mapped TensorDicts",
            "- `dataset.json`: this, for programs",
            "",
            _READ.replace("{column}", observed),
            "",
            "## Columns of steps",
            "",
            "`seed` int64, `step` int32, `uav` int16, `time` float64 (s), and in a TensorDict "
            "under `steps`, dots for keys:",
            "",
            *_table(of_steps),
            "",
            "## Columns of worlds",
            "",
            "`seed` int64, `uav` int16, and in a TensorDict under `worlds`:",
            "",
            *_table(of_worlds),
            "",
        ]
    )


def _table(columns: list[Column]) -> list[str]:
    rows = ["| column | numbers | type | unit | frame |", "|---|---|---|---|---|"]
    for column in columns:
        kind = str(column.dtype).removeprefix("torch.")
        leaf = column.leaf
        rows.append(f"| `{column.title}` | {leaf.width} | {kind} | {leaf.unit} | {leaf.frame} |")
    return rows
