# make demo   set up, then run the main job on a bundled session
# make test   set up, then pass every test: ruff, mypy, pytest
# make bench  the benchmarks: ratios between two things measured in one run
#
# Both set up what they need on a bare Debian or Ubuntu with Python 3.11 or newer, as root or with sudo.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
SYSTEM := libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1
JOBS ?= 2

# Small matrices: threads of the linear algebra only get into each other's way.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: demo test bench setup system

demo: setup
	$(BIN)/optshape demo

test: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n $(JOBS) -m "not benchmark"

bench: setup
	$(BIN)/python -m pytest -m benchmark -s tests/benchmarks

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml | system
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "optshape needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version). Set PYTHON=..."; exit 1; }
	@echo "Installing optshape and all it can use into $(VENV)"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	@touch $@

# Debian's and Ubuntu's packages that Open3D loads, and Python's own venv module where it is split off.
system:
	@missing=""; \
	for package in $(SYSTEM); do \
	  dpkg-query --show --showformat='$${Status}' $$package 2>/dev/null | grep -q 'ok installed' || missing="$$missing $$package"; \
	done; \
	$(PYTHON) -c 'import ensurepip' 2>/dev/null || missing="$$missing python3-venv"; \
	if [ -n "$$missing" ]; then \
	  echo "Installing system packages:$$missing"; \
	  if [ "$$(id -u)" = 0 ]; then sudo=; else sudo=sudo; fi; \
	  $$sudo apt-get update -qq && $$sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $$missing >/dev/null; \
	fi
