# Two commands do everything on a fresh Debian or Ubuntu machine: `make demo` and `make test`.
# Both first call tools/prepare: .venv, pinned dependencies, Debian packages (says so; without root: says what to type).

SHELL := /bin/bash
PYTHON ?= python3
VENV_PYTHON := .venv/bin/python
SEED ?= 1

.PHONY: demo test test-long lint wheel lock help

help:
	@echo "make demo    firmware on a real CAN bus drives the simulated crane actuator; log, report and proofs"
	@echo "make test    every check: lint, all test lanes, the CAN tests on a real vcan0"
	@echo "make test-long [SEED=N]   campaigns that take too long for every day, each drawn from one seed"
	@echo "make lint    ruff only"
	@echo "make wheel   dist/hilrunner-*.whl"
	@echo "make lock    write the lock files anew from what is installed in .venv"

demo:
	@$(PYTHON) tools/prepare demo
	@$(VENV_PYTHON) tools/demo

test:
	@$(PYTHON) tools/prepare test
	@$(VENV_PYTHON) tools/test_all

test-long:
	@$(PYTHON) tools/prepare test
	@$(VENV_PYTHON) tools/test_long --seed $(SEED)

lint:
	@$(PYTHON) tools/prepare test
	@$(VENV_PYTHON) -m ruff check .
	@$(VENV_PYTHON) -m ruff format --check .

wheel:
	@$(PYTHON) tools/prepare demo
	@rm -rf build
	@$(VENV_PYTHON) -m pip wheel -q --no-deps --no-build-isolation -w dist .
	@ls dist/*.whl

lock:
	@$(PYTHON) tools/prepare test
	@$(VENV_PYTHON) tools/lock
