# The verbs of the project; `make help` lists them. The environment makes itself on first use.
SHELL := /bin/bash
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
.PHONY: help env demo test test-fast test-physics lint type bench bench-peers docs clean lock

# The stamp stands for what the environment was made from: as long as it is there, set-up takes no time. The folder
# counts too, because a virtual environment does not survive being moved.
HASH := $(shell { cat requirements.lock pyproject.toml .ci/setup; pwd; } | { sha256sum 2>/dev/null || shasum -a 256; } | cut -c1-16)
STAMP := .venv/stamp-$(HASH)
BIN := .venv/bin

# Rendering without a screen, no thread storms on shared cores, and no test that waits for the network.
export MUJOCO_GL ?= $(if $(filter Linux,$(shell uname -s)),egl,)
TEST_ENV := HF_HUB_OFFLINE=1 WANDB_MODE=disabled OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} 
PYTEST := $(TEST_ENV) $(BIN)/python -m pytest
# Two test processes halve the time and fit into 8 GB; `make test PYTEST_ARGS=-n0` runs them one by one.
PYTEST_ARGS ?= -n 2 --dist loadfile

help:  ## list the verbs
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-14s %s\n", $$1, $$2}' Makefile

env: $(STAMP)  ## .venv with exactly what requirements.lock names (finds Python 3.12 by itself)

$(STAMP):
	@./.ci/setup $@

demo: $(STAMP)  ## the whole way on a clip made here: video, robot, dataset; ends by naming the report to open
	$(BIN)/vid2demo demo --out runs/demo

test: $(STAMP)  ## the whole test suite
	$(PYTEST) $(PYTEST_ARGS) -m "not exhaustive"

test-fast: $(STAMP)  ## without the slow tests, under three minutes
	$(PYTEST) $(PYTEST_ARGS) -m "not slow and not exhaustive"

test-physics: $(STAMP)  ## every vessel at 50, 100 and 300 particles in 20 violent motions: half an hour
	$(PYTEST) $(PYTEST_ARGS) -m exhaustive

lint: $(STAMP)  ## ruff: rules and formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# The repository root is the package, so mypy meets it through a folder in which it bears its name.
type: $(STAMP)  ## mypy --strict on the four packages and the command
	@mkdir -p build/typing && ln -sfn "$(CURDIR)" build/typing/vid2demo
	MYPYPATH=build/typing $(BIN)/mypy -p vid2demo.extract -p vid2demo.envs -p vid2demo.demos -p vid2demo.policies \
	  -m vid2demo.cli -m vid2demo.run -m vid2demo.report

bench: $(STAMP)  ## the measurements of bench/, one after the other
	@set -e; for script in bench/[a-z]*.py; do \
	  if [ -e "$$script" ] && [ "$$script" != bench/peers.py ]; then echo "== $$script"; OMP_NUM_THREADS=1 $(BIN)/python "$$script"; fi; done

bench-peers: $(STAMP)  ## steps/s of other projects' environments beside ours; fetches them into build/peers first
	$(BIN)/python bench/peers.py

docs: $(STAMP)  ## docs/environment.md, written anew from the code
	$(BIN)/python -m vid2demo.envs.docs_page

lock: $(STAMP)  ## requirements.lock from pyproject.toml, names and versions only (UPGRADE=1: newest versions)
	$(BIN)/uv pip compile pyproject.toml --all-extras --python $(BIN)/python --quiet $(if $(UPGRADE),--upgrade) \
	  --no-emit-index-url --no-emit-find-links --no-annotate --no-header --output-file requirements.lock

clean:  ## remove what make and the tests made, but not .venv or runs/
	rm -rf build dist .pytest_cache .ruff_cache .mypy_cache .hypothesis *.egg-info
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
