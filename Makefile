# Needs Python 3.11, git and make. uv is installed into .venv if it is missing.
PYTHON ?= $(shell command -v python3.11 || echo python3)
BIN := .venv/bin
UV := $(shell command -v uv 2>/dev/null || echo $(BIN)/uv)
SYNC := UV_PROJECT_ENVIRONMENT=.venv $(UV) sync --locked --inexact --compile-bytecode

.PHONY: help play train test test-all mutants figures docs check setup clean

help:                   ## show these targets
	@grep -hE '^[a-z.-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

train: setup            ## install, train the main task and leave a run folder
	$(BIN)/brokk mode=train

play: setup             ## install, and watch the shipped policy in a browser
	$(BIN)/brokk mode=play

test: setup             ## the tests that need no GPU, without the slow ones
	$(BIN)/python -m pytest -q -n auto --maxprocesses 8 --dist loadfile -m "not gpu and not slow"

test-all: setup         ## the slow tests too
	$(BIN)/python -m pytest -q -m "not gpu"

mutants: setup          ## one small change at a time to what decides about the valves: do the tests notice?
	$(BIN)/python tests/mutants.py

figures: setup          ## what the figures of the docs rest on, and which are older than their code
	$(BIN)/python benchmarks/figures.py

docs: setup             ## the documentation site, in site/; search works once it is served: python -m http.server -d site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

check: setup            ## format, lint, types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

setup: .venv/.synced    ## the environment of uv.lock in .venv

.venv/.synced: uv.lock pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	command -v $(UV) >/dev/null || $(BIN)/python -m pip install --quiet uv
	$(SYNC) || UV_SYSTEM_CERTS=1 $(SYNC)  # behind a proxy only the system has the certificates
	touch $@

clean:                  ## remove what can be made again; runs and recordings stay
	rm -rf .venv dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
