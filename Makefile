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

.PHONY: demo test quick lint docs packages results versions clean
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

# a file of tests shares what it solves
test: lint $(VENV)/.optional
	$(BIN)/python -m pytest -n logical --maxprocesses 4 --dist loadfile

quick: $(VENV)/.installed
	$(BIN)/python -m pytest -m 'not slow'

$(VENV)/.docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev,docs]' && touch $@

# everything that test, quick and docs install, so that they can run beside each other
packages: $(VENV)/.optional $(VENV)/.docs

# the documentation in site/; a warning is an error
docs: $(VENV)/.docs
	$(BIN)/mkdocs build --strict --quiet

# lowest and newest packages, Python 3.11 to 3.13, odd surroundings: an hour, most of it installation
versions: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check nox
	$(BIN)/nox

# every table and picture of results/; a command that fails does not end the others, one that was
# stopped continues
BENCH = -$(BIN)/python -m benchmarks
PAIRS = --suite rendered $(if $(DATA),--suite shared --data $(DATA))
results: $(VENV)/.optional
	-$(BIN)/soup-nlp solve problems/motorcycle.yaml -o out/motorcycle --overwrite
	-cp out/motorcycle/overview.png results/motorcycle.png
	$(BENCH) accuracy -o results/accuracy $(PAIRS)
	$(BENCH) sigma results/accuracy
	$(BENCH) chain -o results/accuracy $(if $(DATA),--data $(DATA))
	$(BENCH) paper -o results/paper $(if $(DATA),--data $(DATA)) --limit 1 --superpixels 1000 \
		--analysis 100
	$(BENCH) speed -o results/speed --scenes street,room,orbit,motorcycle --superpixels 1000,2000
	$(BENCH) speed -o results/speed --name cost --scenes street --widths 512,1024,1792 \
		--superpixels 250,1000,2000 --set refine.enabled=true
	$(BENCH) family out/tangent --sizes 100,250 --starts hard --formulation tangent/smooth
	$(BENCH) family out/matrix --sizes 100 --starts hard
	$(BENCH) solvers out/tangent out/matrix -o results/solvers --seconds 10 --iterations 500 \
		--solvers ipopt,ipopt-adaptive,ipopt-tuned,ipopt-lbfgs,pounce,pounce-tuned,soup-nlp

clean:
	rm -rf $(VENV) out site
