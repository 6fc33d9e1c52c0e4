# make demo: install, render a demo set, make its submission, score it, draw a pair.
# make test: install, lint, types, tests.
# make ray: the tests of worker machines, with Ray installed beside the rest.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := demo

.PHONY: demo test ray install lint tests clean

demo: install
	$(BIN)/python -m mkpc_kaggle demo --out $(DEMO)
	$(BIN)/python make_submission.py --test-dir $(DEMO)/test --recipe auto --output $(DEMO)/submission.csv
	$(BIN)/python -m mkpc_kaggle check $(DEMO)/submission.csv --test-dir $(DEMO)/test
	$(BIN)/python make_submission.py --test-dir $(DEMO)/test --recipe auto --mode whole-images \
	    --output $(DEMO)/single_stage.csv
	$(BIN)/python -m mkpc_kaggle match $(DEMO)/train/courtyard/images/courtyard_0005.jpg \
	    $(DEMO)/train/courtyard/images/courtyard_0000.jpg --out $(DEMO)/pair.png
	@echo
	@$(BIN)/python -m mkpc_kaggle validate --train-dir $(DEMO)/train --truth $(DEMO)/test_truth.csv \
	    --submission $(DEMO)/single_stage.csv --submission $(DEMO)/submission.csv
	@echo "submission: $(DEMO)/submission.csv   figure: $(DEMO)/pair.png"

test: install lint tests

lint:
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

tests:
	$(BIN)/python -m pytest

ray: install
	$(BIN)/python -m pip install --quiet "ray>=2.9"
	$(BIN)/python -m pytest tests/test_ray.py tests/test_cluster.py

install: $(VENV)/installed

$(VENV)/installed: requirements-dev.txt pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --requirement requirements-dev.txt
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

clean:
	rm -rf $(VENV) $(DEMO)
