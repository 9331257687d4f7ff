# Everything a user runs. `make bench` and `make test` do all the set-up first, on a machine with Python and make only.
PROFILE ?= standard
TASK ?=
JOBS ?=
TEST_JOBS ?= 2
BIN := .venv/bin

# One thread a worker: the suite is parallel over episodes, and nested threads only fight for the cores.
OMP_NUM_THREADS ?= 1
export OMP_NUM_THREADS
export PYTHON
ifeq ($(shell uname -s),Linux)
MUJOCO_GL ?= egl
export MUJOCO_GL
endif

.DEFAULT_GOAL := help
.PHONY: help setup bench demos test test-slow perf docs lint clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  Variables: PROFILE=smoke|standard|full  TASK=cart-pole  JOBS=2  PYTHON=python3.12"

setup: ## install what is missing; the other targets do it themselves
	@bash scripts/setup.sh

bench: setup ## run the benchmark and write the leaderboard (PROFILE=, TASK=, JOBS=)
	$(BIN)/safeswitch bench --profile $(PROFILE) $(if $(TASK),--task $(TASK)) $(if $(JOBS),--jobs $(JOBS))

demos: setup ## record the expert's demonstrations only (PROFILE=, TASK=, JOBS=)
	$(BIN)/safeswitch demos --profile $(PROFILE) $(if $(TASK),--task $(TASK)) $(if $(JOBS),--jobs $(JOBS))

test: setup ## run the tests, without the slow ones
	$(BIN)/python -m pytest -m "not slow" -n $(TEST_JOBS)

# With every extra that some slow test would be skipped without.
test-slow: ## run the slow tests: packaging, long properties, full protocols, the report in a browser, documentation
	@bash scripts/setup.sh dev,browser,docs,perf,rl,tensorboard,video
	$(BIN)/python -m pytest -m slow -n $(TEST_JOBS)

perf: ## time the expert, pictures, decisions from images and the handover table, each beside a rival
	@bash scripts/setup.sh dev,perf
	$(BIN)/python -m safeswitch.perf

docs: ## build the documentation site in build/docs; a warning is an error
	@bash scripts/setup.sh dev,docs
	$(BIN)/python -m sphinx -W --keep-going -n -q -b html docs build/docs
	@echo "documentation in build/docs/index.html"

lint: setup ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/mypy

clean: ## remove .venv, builds and caches; keeps the store of results in .safeswitch
	rm -rf .venv build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
