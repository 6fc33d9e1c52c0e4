# make demo: install
	$(BIN)/mkpc demo --out $(DEMO)
	$(BIN)/python make_submission.py --test-dir $(DEMO)/test --recipe auto --output $(DEMO)/submission.csv
	$(BIN)/mkpc check $(DEMO)/submission.csv --test-dir $(DEMO)/test
	@echo
	@$(BIN)/mkpc validate --train-dir $(DEMO)/train --truth $(DEMO)/test_truth.csv --submission $(DEMO)/submission.csv
	@echo
	@$(BIN)/python -m benchmarks.two_pairs $(DEMO)/train --out $(DEMO)/pair.png
	@echo
	@echo "Open $(DEMO)/submission.html: the report of the run. $(DEMO)/pair.png shows the first of the two pairs."

quick: install
	$(BIN)/python -m pytest --numprocesses $(TEST_PROCESSES) --dist loadfile $(QUICK)

test: install lint tests

lint:
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

tests:
	$(BIN)/python -m pytest --numprocesses $(TEST_PROCESSES) --dist loadfile

ray: install
	$(BIN)/python -m pip install --quiet "ray>=2.9"
	$(BIN)/python -m pytest tests/engine/test_ray.py tests/engine/test_cluster.py

hostile: install
	$(BIN)/python -m pytest --slow tests/hostile --quiet --numprocesses $(TEST_PROCESSES) --dist load

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
