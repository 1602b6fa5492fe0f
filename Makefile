# make demo           set up, then run the main job on a bundled session
# make test           set up, then pass every test: ruff, mypy, pytest
# make check          set up, then what is quick of it: lint, types, and the tests of QUICK; two minutes on two cores
# make faults         the search for faults, longer than in the tests: broken inputs, full disks, signals, hostile names
# make bench          the benchmarks: ratios between two things measured in one run
# make coverage       the lines that `make test` runs, and those that it does not
# make leaderboard    four methods on the same clouds, into docs/leaderboard.md
# make notebooks      run the notebooks, and store them with their pictures
# make docs           the documentation, as a site in build/site
# make release-check  wheel and sdist, the wheel tried in a fresh environment of every Python in PYTHONS
#
# make compiled       the compiled library, where there is a C compiler; every target that sets up tests does it, too
# make lock           write down the versions that the tests run with: .ci/constraints.txt, docs/licences.md
# make latest         the tests with the newest versions there are, upper bounds left out: to be run now and then
# make sbom           what is in the environment, as CycloneDX: build/sbom.json
#
# All set up what they need on a bare Debian or Ubuntu with Python 3.11 or newer, as root or with sudo (.ci/setup). To
# choose: PYTHON=python3.13 VENV=/some/folder JOBS=4; of `latest`, TESTS="tests/io tests/pose" in place of all

PYTHON ?=
VENV ?= .venv
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
FAULTS ?= 10
TESTS ?=
PYTHONS ?= $(VENV)/bin/python
BIN := $(VENV)/bin

# Small matrices: threads of the linear algebra only get into each other's way.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

# Tests of a file stay in one process, which makes what they share once: half of what is made otherwise.
PYTEST := $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

# Folders of tests that need no process of their own.
QUICK := $(wildcard tests/test_*.py) $(addprefix tests/,factors graph io pose design runs docs/test_docstrings.py cli/test_lazy.py)

.PHONY: demo check test compiled faults bench leaderboard notebooks coverage docs release-check lock latest sbom

demo: setup-plot
	$(BIN)/optshape demo

check: setup-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(PYTEST) -q -m "not benchmark and not slow" $(QUICK)

test: setup-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(PYTEST) -m "not benchmark"

faults: setup-test
	FAULTS=$(FAULTS) $(BIN)/python -m pytest -n $(JOBS) -m "not benchmark" tests/faults

bench: setup-test
	$(BIN)/python -m pytest -m benchmark -s tests/benchmarks

leaderboard: setup-test
	$(BIN)/python -m tests.leaderboard

notebooks: setup-test
	$(BIN)/python -m tests.notebooks

coverage: setup-test
	$(PYTEST) -m "not benchmark" --cov --cov-report=term:skip-covered

docs: setup-docs
	PYTHONPATH=docs $(BIN)/python -m zensical build --clean --strict

release-check: setup-test
	rm -rf build/dist
	$(BIN)/python -m build --outdir build/dist
	@set -e; for python in $(PYTHONS); do \
	  rm -rf build/fresh; $$python -m venv build/fresh; \
	  build/fresh/bin/python -m pip install --quiet build/dist/*.whl; \
	  (cd build/fresh && bin/python "$(CURDIR)/tests/release/smoke.py"); \
	done

lock: setup-test
	$(BIN)/python .ci/lock $(BIN)/python

latest:
	rm -rf build/latest
	$(or $(PYTHON),python3) -m venv build/latest
	build/latest/bin/python .ci/latest > build/latest/wanted.txt
	build/latest/bin/python -m pip install --quiet --upgrade pip -r build/latest/wanted.txt
	build/latest/bin/python -m pip install --quiet --no-deps --editable .
	build/latest/bin/python -m pytest -n $(JOBS) -m "not benchmark" $(TESTS)

sbom: setup-test setup-supply
	mkdir -p build
	$(BIN)/cyclonedx-py environment --output-reproducible --of JSON -o build/sbom.json $(BIN)/python

compiled: setup-test

setup-%:
	@.ci/setup $(VENV) $* $(PYTHON)
	@$(BIN)/python optshape_graph/compiled/build.py
