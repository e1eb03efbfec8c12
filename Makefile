# Everything here needs only Python 3.10 or newer, git and make. `make help` lists the targets.

ROS_DISTRO ?= jazzy
PYTEST_ARGS ?=
VENV_PYTHON := .venv/bin/python

# A sourced ROS installation or another environment of wheels must not leak into this one.
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH VIRTUAL_ENV
# What a process has compiled the hundreds that tests start after it need not: half of a collection is that.
unexport PYTHONDONTWRITEBYTECODE
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
ifneq ($(AMENT_PREFIX_PATH)$(_ROS_WHEELS_BOOTSTRAP_COMPLETE),)
unexport LD_LIBRARY_PATH
endif

SUITABLE := import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 14))

.DEFAULT_GOAL := help
.PHONY: help setup test test-long test-fast lint format demo demo-live docs bench fuzz soak clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-9s %s\n", $$1, $$2}' Makefile
	@echo "  ROS_DISTRO=kilted selects ROS 2 Kilted (default: jazzy), PYTHON=... the interpreter."

setup: ## make .venv with everything in it (quick when it is there)
ifdef PYTHON
	@command -v "$(PYTHON)" >/dev/null && "$(PYTHON)" -c '$(SUITABLE)' || \
	  { echo "setup: PYTHON=$(PYTHON) is no Python 3.10 to 3.14; choose another" >&2; exit 2; }
	@"$(PYTHON)" scripts/setup_env.py --distro "$(ROS_DISTRO)" --this-python
else
	@for python in python3 python3.12 python3.13 python3.11 python3.10 python3.14; do \
	  if $$python -c '$(SUITABLE)' >/dev/null 2>&1; then \
	    exec $$python scripts/setup_env.py --distro "$(ROS_DISTRO)"; fi; done; \
	echo "setup: no Python 3.10 to 3.14 on the PATH; install one or call make PYTHON=..." >&2; \
	exit 2
endif

lint: setup ## style (ruff) and types (mypy)
	@$(VENV_PYTHON) -m ruff check .
	@$(VENV_PYTHON) -m ruff format --check --quiet . || \
	  { echo "lint: \`make format\` would change the files of \`ruff format --check .\`" >&2; exit 1; }
	@$(VENV_PYTHON) -m mypy

format: setup ## bring the source into the form that lint wants
	@$(VENV_PYTHON) -m ruff check --fix .
	@$(VENV_PYTHON) -m ruff format .

# Nodes wait for most of their time: two processes use 0.6 of two cores, three nearly all. With more, nodes are late as
# they would not be on a microscope's computer.
# Tests of several processes are tried once more, but no more than four in a run: the fifth one fails.
PYTEST := $(VENV_PYTHON) -m pytest -q -W error -n 3 --dist worksteal --rerun-show-tracebacks --max-suite-reruns=4
# No test may take longer than 600 s. One that waits within the middleware for ever does not hear its time limit: its
# process is ended.
END_STUCK := -o faulthandler_timeout=700 -o faulthandler_exit_on_timeout=true

test: lint ## style, types, and all tests but the long ones (5 to 16 minutes on two cores)
	@$(PYTEST) $(END_STUCK) $(PYTEST_ARGS) tests

test-long: setup ## what takes long by nature: whole examples, tutorials, networks, endurance
	@$(PYTEST) $(END_STUCK) -m long $(PYTEST_ARGS) tests

test-fast: setup ## the quick tests: no running nodes, no whole experiments, no fuzzing
	@$(PYTEST) -m "not slow and not long" --ignore tests/nodes --ignore tests/fuzz $(PYTEST_ARGS) tests

demo: setup ## virtual SEM, calibration, live nodes, report: the whole thing working
	@$(VENV_PYTHON) -m examples.demo

demo-live: setup ## the virtual SEM live in the browser, raw and corrected
	@$(VENV_PYTHON) -m semcal_ros demo

docs: setup ## the documentation site, into site/
	@$(VENV_PYTHON) scripts/build_docs.py

# Where what they compare with cannot be installed, the tables say so.
bench: setup ## the benchmarks, as a table (installs what they compare with into .venv)
	@$(VENV_PYTHON) -m pip install --quiet --no-input --disable-pip-version-check --no-deps \
	  --no-build-isolation --use-pep517 -r requirements/bench.txt || \
	  echo "bench: requirements/bench.txt could not be installed; going on without" >&2
	@$(VENV_PYTHON) benchmarks/run.py

# A failure comes with its example; the seed makes the whole run again.
FUZZ_CASES ?= 2400
ifndef FUZZ_SEED
FUZZ_SEED := $(shell date +%s)
endif

fuzz: setup ## over 100 000 damaged inputs, and all properties with other examples each time
	@echo "fuzz: FUZZ_SEED=$(FUZZ_SEED)"
	@SEMCAL_FUZZ_CASES=$(FUZZ_CASES) $(PYTEST) -m hypothesis --timeout 3600 \
	  --hypothesis-seed=$(FUZZ_SEED) $(PYTEST_ARGS) tests || \
	  { echo "fuzz: to repeat this run: make fuzz FUZZ_SEED=$(FUZZ_SEED)" >&2; exit 1; }

soak: setup ## the suite broken every second (SEMCAL_SOAK_S=600, SEMCAL_SOAK_SEED=0)
	@$(VENV_PYTHON) -m pytest -q -s -W error tests/soak/soak_nodes.py

clean: ## remove what make and the tools made, .venv too
	rm -rf site .venv .venv-docs .venv-jazzy .venv-kilted .venv.lock build install log demo_output bench_output
	rm -rf cantilever_output nano_ball_output visual_servo_output
	rm -rf .mypy_cache .pytest_cache .ruff_cache .hypothesis semcal_ros.egg-info
	find semcal_ros tests examples benchmarks launch scripts -name __pycache__ -type d \
	  -prune -exec rm -rf {} + 2>/dev/null || true
