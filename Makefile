# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
#
# make demo   sets up .venv, plays a sample bag over DDS into the node, prints the remaining drift
# make test   sets up .venv, runs the test suite
# make slow   runs the tests that `make test` leaves out: further units, long statistics (4 min)
# make lint   runs ruff, mypy --strict and the layering test
# make nightly  runs `make slow`, and test_properties.py with 10000 examples for each property
# make oldest  runs the tests with the oldest libraries that setup.py allows, in .venv-oldest
# make fuzz   runs each fuzz target for FUZZ_SECONDS (default: 60)
# make bench  installs the package in .venv-bench and measures its speed (half an hour)
# make docs   builds the documentation as a site, in site/
# make clean  removes .venv, .venv-bench, .venv-oldest and all generated files

PYTHON ?= python3
VENV ?= .venv
JOBS ?= 3
FUZZ_SECONDS ?= 60
PYTEST_ARGS ?=

# Interpreters in the order of preference: PYTHON, then the newest interpreter with ROS wheels.
CANDIDATES := $(PYTHON) python3.12 python3.11 python3.10 python3.13
BIN := $(VENV)/bin

# A sourced ROS workspace would shadow the wheels in the venv.
unexport PYTHONPATH
unexport AMENT_PREFIX_PATH
unexport COLCON_PREFIX_PATH
unexport LD_LIBRARY_PATH
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Keep compiled modules: otherwise each of the many processes of the tests compiles them again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test slow lint nightly oldest fuzz bench docs clean help
.DEFAULT_GOAL := help

help:
	@sed -n 's/^# \(make .*\)/\1/p' Makefile

demo: $(VENV)/.installed
	@echo "thermo_comp: fits nine sample bags with three models, plays a tenth through the node (1 min)"
	$(BIN)/python benchmarks/demo.py --out out

test: $(VENV)/.installed-test
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --dist loadscope --no-loadscope-reorder $(PYTEST_ARGS)

slow: $(VENV)/.installed-test
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow -n $(JOBS) $(PYTEST_ARGS)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --strict thermo_comp
	$(BIN)/python -m pytest test/test_layers.py

nightly: slow
	$(BIN)/python -m pytest --hypothesis-profile=nightly -n $(JOBS) test/test_properties.py

# Tests with the oldest series of each library that setup.py allows, such as numpy 1.26.*.
oldest:
	grep -oE "'[A-Za-z0-9-]+(\[[a-z]+\])?>=[0-9.]+" setup.py \
	  | sed -E "s/'([A-Za-z0-9-]+)(\[[a-z]+\])?>=([0-9.]+)/\1==\3.*/" | sort -u > oldest.txt
	PIP_CONSTRAINT=$(CURDIR)/oldest.txt $(MAKE) test VENV=.venv-oldest

fuzz: $(VENV)/.installed-fuzz
	$(BIN)/python fuzz/run.py all --seconds $(FUZZ_SECONDS)

# The package is not installed in place, so the figures are those of a user's installation.
bench: | $(BIN)/python
	$(BIN)/python -m venv $(VENV)-bench
	$(VENV)-bench/bin/python -m pip install -qq --disable-pip-version-check '.[ros,test]'
	$(VENV)-bench/bin/python benchmarks/bag_read.py
	$(VENV)-bench/bin/python benchmarks/replay.py --hours 24 --compression none
	$(VENV)-bench/bin/python benchmarks/fit_scaling.py
	$(VENV)-bench/bin/python benchmarks/node_relay.py

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir site

clean:
	rm -rf $(VENV) $(VENV)-bench .venv-oldest oldest.txt build install log out site *.egg-info .mypy_cache .ruff_cache .pytest_cache

$(BIN)/python:
	@found=; \
	for python in $(CANDIDATES); do \
	  if command -v $$python >/dev/null 2>&1 \
	    && $$python -c 'import sys; raise SystemExit(sys.version_info < (3, 10))' 2>/dev/null; \
	  then found=$$python; break; fi; \
	done; \
	if [ -z "$$found" ]; then \
	  echo "thermo_comp: needs Python 3.10 or newer; $(PYTHON) is" \
	    "$$($(PYTHON) --version 2>&1 || true). Install one, or: make PYTHON=/path/to/python3" >&2; \
	  exit 1; \
	fi; \
	echo "thermo_comp: $$found makes the environment $(VENV)"; \
	$$found -m venv $(VENV) || { \
	  echo "thermo_comp: $$found cannot make a venv; on Debian and Ubuntu:" \
	    "sudo apt install python3-venv" >&2; exit 1; }
	$(BIN)/python -m pip install -qq --disable-pip-version-check --upgrade 'pip>=24'

$(VENV)/.installed: setup.py setup.cfg pyproject.toml | $(BIN)/python
	@echo "thermo_comp: pip installs the package, numpy, scipy, matplotlib and rclpy into $(VENV): a few minutes"
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -e '.[ros]'
	@touch $@

$(VENV)/.installed-test: setup.py setup.cfg pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install -qq --disable-pip-version-check \
	  -e '.[ros,test,parquet,px4,ardupilot,fleet]'
	@touch $(VENV)/.installed $@

$(VENV)/.installed-dev: $(VENV)/.installed-test
	$(BIN)/python -m pip install -qq --disable-pip-version-check -e '.[dev]'
	@touch $@

$(VENV)/.installed-fuzz: $(VENV)/.installed
	$(BIN)/python -m pip install -qq --disable-pip-version-check -e '.[ros,fuzz]'
	@touch $@

$(VENV)/.installed-docs: setup.py setup.cfg pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install -qq --disable-pip-version-check -e '.[docs]'
	@touch $@
