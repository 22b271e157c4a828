# Needs Python 3.11, git and make. uv is installed into .venv if it is missing.
PYTHON ?= $(shell command -v python3.11 || echo python3)
BIN := .venv/bin
UV := $(shell command -v uv 2>/dev/null || echo $(BIN)/uv)
SYNC = UV_PROJECT_ENVIRONMENT=.venv $(UV) sync --locked --inexact --compile-bytecode $(if $(EXTRA),--no-dev --extra $(EXTRA))
# Torch and its CUDA libraries take 5 GB of 8. Without an NVIDIA GPU the same version for the CPU takes their place.
TORCH ?= $(if $(filter Darwin,$(shell uname -s)),lock,$(shell nvidia-smi -L >/dev/null 2>&1 && echo lock || echo cpu))
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
TORCH_VERSION ?= $(shell sed -n '/^name = "torch"$$/{n;s/.*"\(.*\)"/\1/p;}' uv.lock)
GET_TORCH = $(UV) pip install --quiet --python $(BIN)/python --no-deps --default-index $(TORCH_INDEX) torch==$(TORCH_VERSION)
NO_CUDA = $(shell sed -nE 's/^name = "(torch|triton|nvidia-.*|cuda-.*)"$$/--no-install-package \1/p' uv.lock)
PRESET ?= $(shell nvidia-smi -L >/dev/null 2>&1 && echo preset=gpu_short || echo preset=laptop)

.PHONY: help play train test test-all mutants results docs docs-commands dist check setup clean

help:                   ## show these targets
	@grep -hE '^[a-z.-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

train: setup            ## install, train the main task and leave a run folder; PRESET= for the defaults, a correction of the controller, 13 minutes
	$(BIN)/brokk mode=train $(PRESET)

play: setup             ## install, and watch the shipped policy in a browser
	$(BIN)/brokk mode=play

test: setup             ## the tests that need no GPU, without the slow ones
	@[ -n "$$CHROMIUM" ] || { command -v chromium || command -v chromium-headless-shell; } >/dev/null || \
	    echo "the tests in a browser are skipped: apt-get install chromium-headless-shell, or CHROMIUM=<path>"
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder -m "not gpu and not slow"

test-all: setup         ## the slow tests too
	$(BIN)/python -m pytest -q -m "not gpu"

mutants: setup          ## one small change at a time to what decides about the valves: do the tests notice?
	$(BIN)/python tests/mutants.py

results: setup          ## render docs/results.md, and mark what is older than its code
	$(BIN)/python benchmarks/run.py page

docs: setup             ## the documentation site, in site/; search works once it is served: python -m http.server -d site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

docs-commands: setup    ## type the commands of README and tutorials, an hour; PAGES= for some of them
	$(BIN)/python tests/type_commands.py $(PAGES)

dist: setup             ## wheel and source distribution, in dist/
	$(UV) build

check: setup            ## format, lint, types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

setup: .venv/.synced    ## the environment of uv.lock in .venv; EXTRA=train leaves out the tools of developers

.venv/.synced: uv.lock pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	command -v $(UV) >/dev/null || $(BIN)/python -m pip install --quiet uv
	@if [ $(TORCH) = cpu ] && echo "torch for the CPU, 5 GB less (for an NVIDIA GPU: make setup TORCH=lock)" && \
	    { $(GET_TORCH) || UV_SYSTEM_CERTS=1 $(GET_TORCH); }; then \
	    flags="$(NO_CUDA)"; \
	elif [ $(TORCH) = cpu ]; then \
	    echo "$(TORCH_INDEX) gives no torch $(TORCH_VERSION): it comes with CUDA, 5 GB more (make setup TORCH_INDEX=<mirror>)"; \
	fi; \
	$(SYNC) $$flags || UV_SYSTEM_CERTS=1 $(SYNC) $$flags  # behind a proxy only the system has the certificates
	touch $@

clean:                  ## remove what can be made again; runs and recordings stay
	rm -rf .venv dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
