# Two commands matter: `make run` and `make test`. Everything they need beyond Python 3.11+, venv, make and a C compiler
# is installed into .venv by the rule below.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SOURCES := pyproject.toml setup.py $(shell find thermoctl -name '*.pyx' -o -name '*.pxd')
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1

.PHONY: run test lint install clean
run: install
	$(BIN)/thermoctl demo --config config/simulated.yaml

test: install lint
	$(BIN)/python -m pytest -m "not slow" tests

lint: install
	$(BIN)/ruff check .
	$(BIN)/mypy

install: $(VENV)/.installed
$(VENV)/.installed: $(SOURCES)
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip setuptools wheel
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	touch $@

clean:
	rm -rf $(VENV) build *.egg-info
	find thermoctl hal -name '*.so' -delete
	find thermoctl -name '*.pyx' | sed 's/pyx$$/c/' | xargs rm -f
