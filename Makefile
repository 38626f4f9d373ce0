# make demo | make test | make test-all | make check: each works on a fresh machine with Python >= 3.11
# and make.
PYTHON ?= python3
# Where torch comes from. Installed first and pinned, so that nothing else chooses a build.
# Another build:  make demo TORCH="torch --index-url URL"
TORCH ?= torch==2.13.0
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet
JOBS ?= 2

PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q
EXTRA := slow or browser or docs or long

.PHONY: demo test test-rest test-all check gate lint docs clean

demo: $(VENV)/.installed
	$(BIN)/mover demo --out demo

test: $(VENV)/.developed
	$(PYTEST) -n $(JOBS) --dist loadfile -m "not ($(EXTRA)) and not gpu and not licensed"

test-rest: $(VENV)/.developed
	$(PYTEST) -n $(JOBS) --dist loadfile -m "($(EXTRA)) and not gpu and not licensed"

test-all: test test-rest

check: lint test

gate: $(VENV)/.developed
	$(BIN)/python benchmarks/gate.py --workers $(JOBS)

lint: $(VENV)/.developed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

docs: $(VENV)/.documented
	$(BIN)/python -m sphinx -W --keep-going -E -q -b html docs docs/_build/html
	@echo docs/_build/html/index.html

$(VENV)/.torch: constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip
	$(PIP) $(TORCH)
	touch $@

$(VENV)/.installed: $(VENV)/.torch pyproject.toml
	$(PIP) --constraint constraints.txt --editable .
	touch $@

$(VENV)/.developed: $(VENV)/.installed
	$(PIP) --constraint constraints.txt --editable ".[dev]"
	touch $@

$(VENV)/.documented: $(VENV)/.installed
	$(PIP) --constraint constraints.txt --editable ".[docs]"
	touch $@

clean:
	rm -rf $(VENV) demo out build dist docs/_build .pytest_cache .ruff_cache
