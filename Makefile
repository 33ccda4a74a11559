# Two commands for a new machine with Python 3.11+, make and git: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
WORKERS ?= auto
# Neighbours in a file share what they set up: each worker begins with a half of its own.

.PHONY: demo test lowest quick docs format lint types imports unit clean

demo: $(VENV)/.ready
	$(BIN)/crosscue demo -o demo --overwrite

# The site is built on one core while tests wait for theirs, so both together take less time.
test: lint
	$(MAKE) --jobs=3 --no-print-directory types imports unit docs

# Readers, CAN, detectors and scoring with each dependency at its lowest version, in a folder removed afterwards.
lowest:
	PYTHON=$(PYTHON) WORKERS=$(WORKERS) .ci/lowest

lint: $(VENV)/.ready-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: $(VENV)/.ready-dev
	$(BIN)/mypy
	$(BIN)/mypy tests benchmarks

imports: $(VENV)/.ready-dev
	$(BIN)/lint-imports

unit: $(VENV)/.ready-dev
	$(BIN)/pytest -n $(WORKERS) --dist worksteal

# The site, in docs/_build/html; warnings are errors. Reference pages are made from the code.
docs: $(VENV)/.ready-dev
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet docs docs/_build/html

# Tests of what differs from main, by package, and by part of eval: make quick, or
# make quick IN="replay eval/scoring".
CHANGED = git diff --name-only $$(git merge-base HEAD origin/main 2>/dev/null || echo HEAD)
PART = s,^(replay|detectors|fusion|localization|datasets|eval/[a-z]+)/.*,\1,p;s,^eval/cli\.py$$,eval/cli,p
IN ?= $(shell $(CHANGED) | sed -nE '$(PART)' | sort -u)
quick: $(VENV)/.ready-dev
	$(BIN)/ruff check . && $(BIN)/lint-imports
	$(if $(IN),$(BIN)/pytest -q -n $(WORKERS) --dist worksteal -m "not slow" $(addprefix tests/,$(IN)),@echo "no package differs from main; name some: make quick IN=eval/scoring")

format: $(VENV)/.ready-dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) demo docs/_build docs/notebooks .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "crosscue needs Python 3.11 or newer; give it as: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.ready: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/.ready-dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@ $(VENV)/.ready
