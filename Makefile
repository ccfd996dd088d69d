# make demo: solve a real pair and a rendered one;  make test: lint, types, tests;  make quick: the fast tests;
# make docs: the documentation;  make results: every table and picture of results/ again (hours;
# DATA=folder of the real pairs).
# Needs Python 3.11+ only.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out/demo

# compiled modules and tests serve the next run
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test quick lint docs results versions clean
.DEFAULT_GOAL := demo

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@

# solvers and networks: where they cannot be had, their tests skip
$(VENV)/.optional: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev,optional]' && touch $@ \
		|| echo "optional packages could not be installed: their tests skip"

demo: $(VENV)/.installed
	$(BIN)/soup-nlp demo --out $(OUT)

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint $(VENV)/.optional
	$(BIN)/python -m pytest

quick: $(VENV)/.installed
	$(BIN)/python -m pytest -m 'not slow'

$(VENV)/.docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev,docs]' && touch $@

# the documentation in site/; a warning is an error
docs: $(VENV)/.docs
	$(BIN)/mkdocs build --strict --quiet

# lowest and newest packages, Python 3.11 to 3.13, odd surroundings: an hour, most of it installation
versions: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check nox
	$(BIN)/nox

results: $(VENV)/.optional
	$(BIN)/soup-nlp bench all --out results --overwrite $(if $(DATA),--data $(DATA))

clean:
	rm -rf $(VENV) out site
