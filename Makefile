# `make demo` sets up a fresh machine and shows the main job; `make test` runs the tests.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
RUNS ?= 10
OUT ?= results
WORKERS ?= auto

PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --maxprocesses 8 --dist worksteal

.PHONY: setup demo test test-all lint docs dist clean

setup: $(VENV)/.installed-dev

$(VENV)/.installed: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	@touch $@ $(VENV)/.installed

demo: $(VENV)/.installed
	@echo "1. Six UAVs in a room: dead reckoning beside a cooperative Kalman filter, 3 runs of 100 s."
	$(BIN)/coloc evaluate indoor-v0 --runs 3 --out $(OUT)/first --agents dead_reckoning,ekf
	@echo "2. The same room: six localizers, $(RUNS) runs."
	$(BIN)/coloc evaluate indoor-v0 --runs $(RUNS) --out $(OUT)/indoor \
		--agents dead_reckoning,ekf,ekf_trust,ekf_joint,pf800,pfnn
	@echo "3. A picture of it."
	$(BIN)/coloc render indoor-v0 --agent ekf --steps 150 --out $(OUT)/indoor/scene.png
	@echo "4. Five real robots: the first 2 minutes of MRCLAM."
	@if $(BIN)/python -c "from coloc_env.datasets import sequences; exit(not sequences('mrclam'))" 2>/dev/null; \
	then $(BIN)/coloc evaluate replay-mrclam-v0 --set span=0:120 --runs 1 --no-bound --out $(OUT)/mrclam \
		--agents dead_reckoning,ekf,ekf:robust=huber,ekf_trust,ekf:robust=huber:cooperate=false; \
	else echo "No recordings found: docs/how-to/recordings.md says where they come from."; fi
	@echo "Tables and figures are in $(OUT)/"

test: setup
	$(PYTEST) -m "not slow"

test-all: test
	$(PYTEST) -m slow

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

dist: setup
	rm -rf dist
	$(BIN)/python -m build
	$(BIN)/python -m pytest -m slow tests/test_packaging.py

clean:
	rm -rf $(VENV) build dist site *.egg-info
