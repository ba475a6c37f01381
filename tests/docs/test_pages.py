"""What pages say of files and measured tables is what there is."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from coloc_env import make_scenario
from coloc_env.observation import all_leaves
from training.evaluation.evaluate import evaluate

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
MEASURED = sorted((DOCS / "results" / "measured").glob("*.json"))
FILES = (DOCS / "reference" / "files.md").read_text(encoding="utf-8")


def documented(section: str) -> set[str]:
    """What stands as code in the first cells of a section's tables."""
    text = FILES.split(f"## {section}")[1].split("\n## ")[0]
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    return {name for cell in cells for name in re.findall(r"`([^`]+)`", cell)}


def test_every_key_of_results_is_documented() -> None:
    scenario = make_scenario("indoor-v0", horizon=5)
    summary = evaluate(scenario, ["pf500"], runs=1).summary
    known = documented("`results.json`")
    assert set(summary) | set(summary["agents"]["pf500"]) <= known


@pytest.mark.parametrize(
    "card", sorted((ROOT / "checkpoints").glob("*.json")), ids=lambda p: p.name
)
def test_every_key_of_a_card_is_documented(card: Path) -> None:
    assert set(json.loads(card.read_text(encoding="utf-8"))) <= documented("Weights and their card")


@pytest.mark.parametrize("file", MEASURED, ids=lambda p: p.stem)
def test_measured_tables_are_whole_and_shown(file: Path) -> None:
    table: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    assert {"title", "caption", "command", "provenance", "header", "align", "rows"} == set(table)
    assert {len(row) for row in (table["align"], *table["rows"])} == {len(table["header"])}
    pages = [page.read_text(encoding="utf-8") for page in DOCS.glob("**/*.md")]
    assert any(re.search(rf"^\[[^\]]+\]\([^)]*/?{file.name}\)$", page, re.M) for page in pages)


def test_every_leaf_of_the_room_names_unit_and_frame() -> None:
    leaves = all_leaves(make_scenario("indoor-v0", anchors=4, comm_radius=10.0))
    flags = {name for name in leaves if name.endswith("mask")} | {"links", "neighbours"}
    assert {name for name, leaf in leaves.items() if not leaf.unit} <= flags
    assert leaves["landmarks"].frame == "body"
    assert leaves["landmark_map"].frame == "world"
