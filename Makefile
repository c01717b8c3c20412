# Everything runs in a virtual environment, .venv, which holds exactly what requirements.lock names.
# Another Python, in another environment: make test PYTHON=python3.10 VENV=.venv-3.10.
# More arguments: make test ARGS="-k lidar".

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help venv demo test lint bench docs clean

PYTHON ?= python3
VENV ?= .venv
ARGS ?=

# Processes of a target share what they compile, also where the environment says that nothing is written.
export PYTHONDONTWRITEBYTECODE :=

BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PIP := $(BIN)/python -m pip --disable-pip-version-check -qq
PEER := $(VENV)/peer/.installed

help: ## show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-7s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

venv: $(STAMP) ## install everything into .venv (the other targets do so when it is needed)

demo: $(STAMP) ## watch a trained rover drive
	$(BIN)/rover-rl demo $(ARGS)

# One thread a worker: the workers share the cores already. Four workers keep two cores busy while some wait for processes
# and sensors. As many open files as Ubuntu allows by default.
test: $(STAMP) $(PEER) ## run the tests
	ulimit -S -n 1024 && OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(BIN)/python -m pytest -n 4 --dist worksteal $(ARGS)

lint: $(STAMP) ## check style, format and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

bench: $(STAMP) ## measure the speed of rollouts and of training
	$(BIN)/python -m benchmarks $(ARGS)

docs: $(STAMP) ## build the documentation into docs/_build/html and check its links
	rm -rf docs/_build
	OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(BIN)/python -m sphinx -W --keep-going -n -b html docs docs/_build/html $(ARGS)
	$(BIN)/python docs/check_links.py docs/_build/html
	@echo docs/_build/html/index.html

clean: ## remove caches and build products; virtual environments and runs/ stay
	rm -rf build dist docs/_build docs/gallery *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage htmlcov
	find rover_rl tests benchmarks -name __pycache__ -prune -exec rm -rf {} +

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c '' || { echo "error: cannot run '$(PYTHON)'; name a Python 3.10 to 3.13: make PYTHON=python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' || { echo "error: rover_rl needs Python 3.10 to 3.13, and '$(PYTHON)' is $$($(PYTHON) -c 'import platform; print(platform.python_version())'); name another one: make PYTHON=python3.11" >&2; exit 1; }
	@echo "Installing into $(VENV); the first time takes a minute or two"
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) install -r requirements.lock
	@$(PIP) install --no-deps --no-build-isolation -e .
	@touch $@

# ROS 2's own rclpy, for tests, which skip those that need it where it cannot be installed.
$(PEER): tests/sims/ros2/peers/requirements.txt | $(STAMP)
ifeq ($(shell uname -sm),Linux x86_64)
	@echo "Installing rclpy into $(@D)"
	@$(BIN)/python -m venv $(@D) && $(@D)/bin/python -m pip --disable-pip-version-check -qq install -r $< && touch $@ \
		|| echo "note: rclpy cannot be installed: no tests with it" >&2
endif
