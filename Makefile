# `make demo` sets up a fresh machine and shows the main job; `make test` runs the tests.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
RUNS ?= 10
OUT ?= results

.PHONY: setup demo test lint clean

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	@touch $@

demo: setup
	$(BIN)/coloc evaluate indoor-v0 --runs $(RUNS) --out $(OUT)/indoor \
		--agents dead_reckoning,ekf,ekf_trust,ekf_joint,pf800,pfnn
	$(BIN)/coloc render indoor-v0 --agent ekf --steps 150 --out $(OUT)/indoor/scene.png
	@if $(BIN)/python -c "from coloc_env.datasets import sequences; exit(not sequences('mrclam'))" 2>/dev/null; \
	then $(BIN)/coloc evaluate replay-mrclam-v0 --runs 1 --no-bound --out $(OUT)/mrclam \
		--agents dead_reckoning,ekf,ekf:robust=huber,ekf_trust,ekf:robust=huber:cooperate=false; \
	else echo "No recordings found: see README.md, 'Real recordings', for where they come from."; fi
	@echo "Tables and figures are in $(OUT)/"

test: setup
	$(BIN)/python -m pytest -m "not slow"

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) build dist *.egg-info
