# derail_ros: environment, demonstration, tests. `make help` lists the targets.
#
#   PYTHON=python3.12   choose the interpreter (default: the first that works, see find_python)
#   ROS=0               leave out the ROS 2 wheels (default: 1 on x86-64 Linux, else 0)

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
MAKEFLAGS += --no-print-directory
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
STAMPS := $(VENV)/stamps
PIP := $(BIN)/python -m pip --disable-pip-version-check
PIP_VERSION := 26.3
ifeq ($(shell uname -sm),Linux x86_64)
ROS ?= 1
else
ROS ?= 0
endif

# Asked for another interpreter than that of the environment: begin anew.
ifdef PYTHON
ifneq ($(wildcard $(STAMPS)/venv),)
ifneq ($(file <$(STAMPS)/venv),$(PYTHON))
$(shell rm -rf $(STAMPS))
endif
endif
endif

# Another environment's Python must not leak into this one, and without its bytecode each of the
# hundreds of processes that tests start would compile the package anew.
unexport PYTHONPATH PYTHONHOME PYTHONDONTWRITEBYTECODE
ifdef _ROS_WHEELS_BOOTSTRAP_COMPLETE
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH AMENT_PREFIX_PATH
endif

# The first interpreter that runs, is recent enough and can make an environment.
CANDIDATES := $(if $(PYTHON),$(PYTHON),python3.11 python3.12 python3.13 python3.10 python3)
define find_python
for python in $(CANDIDATES); do \
  if "$$python" -c 'import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; \
  then break; fi; python=; done; \
if [ -z "$$python" ]; then \
  echo "No Python 3.10 to 3.13 (those that are tried) with the modules venv and ensurepip among: $(CANDIDATES)." >&2; \
  echo "Install one (Debian, Ubuntu: apt-get install python3 python3-venv) or name it: make PYTHON=..." >&2; \
  exit 1; fi
endef

# pip, quietly: its output goes to a file, which is shown if it fails. $(call pip,what,arguments)
define pip
mkdir -p $(VENV)/log; \
$(PIP) $(2) >$(VENV)/log/$(1).txt 2>&1 || { cat $(VENV)/log/$(1).txt >&2; echo "pip failed: $(1)" >&2; exit 1; }
endef

STANDARD_SOURCES := $(wildcard standard_interfaces/* standard_interfaces/*/*)
MSGS_SOURCES := derail_msgs/CMakeLists.txt derail_msgs/package.xml derail_msgs/pyproject.toml \
  $(wildcard derail_msgs/msg/*.msg derail_msgs/srv/*.srv)
PROJECT_SOURCES := setup.py setup.cfg pyproject.toml constraints.txt derail_ros/__init__.py
ifeq ($(ROS),0)
EXTRAS := studies,dev
PARTS := $(STAMPS)/project-$(EXTRAS)
else
EXTRAS := ros,studies,dev
PARTS := $(STAMPS)/msgs $(STAMPS)/standard $(STAMPS)/project-$(EXTRAS)
endif

LINTS := lint-ruff lint-format lint-types lint-walls lint-spelling lint-prose
.PHONY: help env run lint $(LINTS) test test-plain test-ros verify bench docs pages clean

help:  ## list the targets
	@sed -nE 's/^([a-z]+):.*## (.*)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 16

env: $(STAMPS)/env-ros$(ROS)  ## make .venv with everything in it (and .venv/bin/derail)

$(STAMPS)/venv:
	@$(find_python); \
	echo "env: new environment in $(VENV) with $$("$$python" --version), $$(command -v "$$python")"; \
	rm -rf $(VENV); "$$python" -m venv $(VENV); \
	$(call pip,pip,install --upgrade pip==$(PIP_VERSION)); \
	mkdir -p $(STAMPS); echo "$$python" >$@

$(STAMPS)/project-$(EXTRAS): $(PROJECT_SOURCES) | $(STAMPS)/venv
	@echo "env: installing derail_ros [$(EXTRAS)] from this folder and what it needs"
	@$(call pip,project,install --constraint constraints.txt --editable '.[$(EXTRAS)]')
	@touch $@

# The wheel of the messages takes a minute: built beside the rest, and only when they change.
$(STAMPS)/msgs: $(MSGS_SOURCES) | $(STAMPS)/venv
	@echo "env: building derail_msgs against the ROS 2 wheels (about a minute)"
	@command -v "$${CXX:-g++}" >/dev/null || { \
	  echo "derail_msgs needs a C++ compiler (Debian, Ubuntu: apt-get install g++), or make ROS=0" >&2; exit 1; }
	@rm -f $(VENV)/wheels/derail_msgs-*
	@$(call pip,derail_msgs,wheel --no-deps --build-constraint constraints.txt --wheel-dir $(VENV)/wheels ./derail_msgs)
	@touch $@

# What the wheels of PyPI lack of the interfaces of others; built like the messages, and seldom.
$(STAMPS)/standard: $(STANDARD_SOURCES) | $(STAMPS)/venv
	@echo "env: building simulation_interfaces, tf2_msgs and foxglove_msgs against the ROS 2 wheels"
	@rm -f $(VENV)/wheels/derail_standard_interfaces-*
	@$(call pip,standard_interfaces,wheel --no-deps --build-constraint constraints.txt \
	  --wheel-dir $(VENV)/wheels ./standard_interfaces)
	@touch $@

$(STAMPS)/env-ros$(ROS): $(MSGS_SOURCES) $(STANDARD_SOURCES) $(PROJECT_SOURCES)
	@$(MAKE) -s $(STAMPS)/venv
	@$(MAKE) -s -j3 $(PARTS)
	@if [ "$(ROS)" != 0 ]; then \
	  $(call pip,derail_msgs_install,install --no-deps --force-reinstall $(VENV)/wheels/*.whl); fi
	@touch $@
	@echo "env: ready, $(BIN)/derail"

run: env  ## show a derailment
	@$(BIN)/python -m derail_ros.demo

TEST_ENVIRONMENT := ROS_PYTHON_CHECK_FIELDS=1 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST \
  ROS_LOG_DIR=$(CURDIR)/$(VENV)/log/ros MPLBACKEND=agg

# `make lint` goes on after a failure, so that its end shows what all tools found.
lint: env  ## ruff, mypy, the walls between the rooms, spelling and prose
	@$(MAKE) --keep-going $(LINTS)
lint-ruff:
	$(BIN)/ruff check .
lint-format:
	$(BIN)/ruff format --check .
lint-types:
	$(BIN)/mypy
lint-walls:
	$(BIN)/lint-imports --no-cache
lint-spelling:
	$(BIN)/codespell
lint-prose:
	$(BIN)/proselint --config .proselintrc.json check $(wildcard *.md docs/*.md docs/tutorials/*.md)

test-plain: env
	$(TEST_ENVIRONMENT) $(BIN)/python -m pytest -m "not slow and not ros" -n auto \
	  --maxprocesses 8 --dist loadfile $(PYTEST_ARGS)

# Two files at a time: each test starts several processes in a domain of its own, and waits much.
test-ros: env
	$(TEST_ENVIRONMENT) $(BIN)/python -m pytest -m "not slow and ros" -n 2 --dist loadfile \
	  $(PYTEST_ARGS)

# Every part runs, whatever became of those before it; the end names all failures.
TEST_PARTS := lint test-plain $(if $(filter 0,$(ROS)),,test-ros)
test: env  ## everything that must hold, within minutes
	@$(BIN)/python -c 'from derail_ros.engine import warm_up; warm_up()'
	@mkdir -p $(VENV)/log; failed=; for part in $(TEST_PARTS); do \
	  $(MAKE) $$part 2>&1 | tee $(VENV)/log/$$part.txt || failed="$$failed $$part"; done; \
	if [ -n "$$failed" ]; then echo "make test: failed:$$failed"; \
	  for part in $$failed; do grep -E '^(FAILED|ERROR) ' $(VENV)/log/$$part.txt || true; done; \
	  exit 1; fi

REPEATS ?= 10
verify: env  ## the slow tests; those with a ROS graph REPEATS times, and on Jazzy's wheels
	$(TEST_ENVIRONMENT) $(BIN)/python -m pytest -m slow --timeout 3600 $(PYTEST_ARGS)
	for i in $$(seq $(REPEATS)); do \
	  $(TEST_ENVIRONMENT) $(BIN)/python -m pytest -m "ros and not slow" $(PYTEST_ARGS); done
	@if [ "$(ROS)" != 0 ]; then $(TEST_ENVIRONMENT) $(BIN)/python .ci/jazzy.py; fi

bench: env  ## measure, and print the tables of the documentation
	@$(BIN)/python -c 'import mujoco, pymunk, exudyn' 2>/dev/null || { \
	  echo "bench: installing the engines to compare with [bench]"; \
	  $(call pip,bench,install --constraint constraints.txt --editable '.[bench]'); }
	@shopt -s nullglob; for file in benchmarks/bench_*.py; do \
	  echo "== $$file"; $(BIN)/python "$$file"; done

docs: env  ## build the documentation site: build/site/index.html
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "docs: build/site/index.html"

REPORTS ?=
pages: env  ## write the generated pages and figures of docs/ anew (hours); REPORTS: files of accident reports
	$(BIN)/python -m research all $(REPORTS)

clean:  ## remove the environment, builds and caches
	rm -rf $(VENV) build install log dist derail_msgs/build *.egg-info \
	  .mypy_cache .pytest_cache .ruff_cache .hypothesis
