"""Pages of tasks and the leaderboard are what is registered and stored."""

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

from agents.tasks import TASKS, make_task
from agents.tasks.leaderboard import FOLDER
from training.evaluation.score import FIRST_SEED

DOCS = Path(__file__).parents[2] / "docs"
SCORES = sorted(FOLDER.glob("*/*.json"))


def hook(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(f"hook_{name}", DOCS / "hooks" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["survey-v0", "schedule-hard-v0"])
def test_a_tasks_page_tells_all_that_agents_see(name: str) -> None:
    made, page = make_task(name), hook("tasks").page(name)
    rows = hook("tasks").observation(made)
    assert sum(int(row[2]) for row in rows) == made.leaves["observation"].width
    for word in (*made.widths, *made.policies, *TASKS.options_of(name)):
        assert f"`{word}`" in page


@pytest.mark.parametrize("file", SCORES, ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_stored_scores_are_whole_and_shown(file: Path) -> None:
    one = json.loads(file.read_text(encoding="utf-8"))
    assert one["task"] == file.parent.name
    assert one["task"] in TASKS
    assert one["first_seed"] == FIRST_SEED
    assert len(one["returns"]) == one["worlds"]
    assert one["label"] in hook("leaderboard").page()
