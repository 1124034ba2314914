PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.sb3-mcbs-installed
EXTRAS := dev,docs,zoo,plots,box2d,tuning,ray,report,video,hub,onnx

.PHONY: help install train test test-slow docs lint format check-gpu clean support-table
.PHONY: bench-search bench-training bench-scaling bench-memory bench-deadline bench-gradient_step bench-kill bench-soak

help:
	@echo "make train      set up $(VENV), train MCBS-CrossQ on HalfCheetah-v5 for 12 000 steps, report"
	@echo "make test       set up $(VENV), run the tests on all cores (PYTEST_ARGS='-n 0': on one)"
	@echo "make test-slow  the tests that build packages or take long"
	@echo "make docs       the documentation as a site, in docs/_build/html"
	@echo "make lint       ruff and mypy"
	@echo "make format     ruff format, and what ruff check can repair"
	@echo "make support-table  docs/environments.md: which environments work, measured here"
	@echo "make check-gpu  whether gradient steps on this machine's GPU are right, and how fast"
	@echo "make bench-search and other measurements: see docs/speed.md and docs/checkpoints.md"

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# The hook that RL Zoo needs is written at installation, so a change to it installs again.
$(STAMP): $(BIN)/python pyproject.toml setup.cfg constraints.txt _sb3_mcbs_build.py _sb3_mcbs_hook.py
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[$(EXTRAS)]"
	touch $@

install: $(STAMP)

train: $(STAMP)
	$(BIN)/python -m rl_zoo3.train --algo mcbs_crossq --env HalfCheetah-v5 -n 12000 --eval-freq 3000 --seed 0 -P
	$(BIN)/sb3-mcbs report --algo mcbs_crossq --env HalfCheetah-v5

test: $(STAMP)
	$(BIN)/python -m pytest -n auto $(PYTEST_ARGS)

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow $(PYTEST_ARGS)

docs: $(STAMP)
	$(BIN)/python -m sphinx -b html -W --keep-going -q -d docs/_build/doctrees docs docs/_build/html

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench-search bench-scaling bench-memory bench-deadline bench-gradient_step bench-kill bench-soak: bench-%: $(STAMP)
	$(BIN)/python -m benchmarks.$*

# Another environment with the package and pytest does as well: python -m benchmarks.check_gpu
check-gpu: $(STAMP)
	$(BIN)/python -m benchmarks.check_gpu

# SBX (JAX) is a peer to be measured against; it is kept apart.
.venv-sbx/bin/python: benchmarks/requirements-sbx.txt
	$(PYTHON) -m venv .venv-sbx
	.venv-sbx/bin/python -m pip install --quiet -r $<
	touch $@

bench-training: $(STAMP) .venv-sbx/bin/python
	$(BIN)/python -m benchmarks.training --sbx-python .venv-sbx/bin/python

# Environments of others need an older MuJoCo. What cannot be installed is a row that says so.
.venv-support/bin/python: benchmarks/requirements-support.txt
	$(PYTHON) -m venv .venv-support
	grep -v mujoco constraints.txt > .venv-support/constraints.txt
	.venv-support/bin/python -m pip install --quiet -c .venv-support/constraints.txt -e ".[box2d]" "mujoco<4"
	grep -v '^#' $< | while read -r package; do \
	    .venv-support/bin/python -m pip install --quiet -c .venv-support/constraints.txt $$package || \
	    echo "not installed: $$package"; done
	touch $@

support-table: .venv-support/bin/python
	.venv-support/bin/python -m benchmarks.support_table --page docs/environments.md

clean:
	rm -rf build dist docs/_build *.egg-info .pytest_cache .mypy_cache .ruff_cache
