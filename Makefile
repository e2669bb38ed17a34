# gsbake: everything sets itself up in .venv; nothing but Python 3.11–3.13 is needed beforehand.
#   make PYTHON=/path/to/python3.12 …   chooses the Python
#   make DEMO_OUT=… demo                chooses where the demo goes

SHELL := /bin/sh
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.stamp
IN_RANGE := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3 python; do \
	command -v $$p >/dev/null 2>&1 && $$p -c '$(IN_RANGE)' 2>/dev/null && echo $$p && break; done)
TORCH := $(shell grep '^torch==' constraints.txt)
# Byte code is compiled afterwards, on all cores and without the packages' own tests: pip compiles on one core.
PIP_OPTIONS := install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
DEMO_OUT ?= out/demo

# The scorer is a program of its own with an environment of its own (Blender as a module needs Python 3.11).
SCORE_DIR ?= ../shared/score
SCORE_GT ?= ../shared/captures/boombox/gt
SCORE_ASSET ?= out/boombox/asset.glb
SCORE_ARGS ?=

# What `make bench` measures; ARGS go to every part (make bench PARTS=growth ARGS=--help).
PARTS ?= table timeline growth
ARGS ?=

# Damaged files that `make stress` tries per parser.
FUZZ_INPUTS ?= 10000

# Processes that `make test` and `make coverage` share the tests between. The tests of a file stay in one of them, so that what they share,
# a whole bake here and there, is made once.
WORKERS ?= 2
QUICK := -m "not slow and not stress" --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder

.PHONY: help setup node demo docs lab test coverage check bench stress score lock audit sbom clean

help: ## Show this
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 10

setup: $(STAMP) ## Make .venv with exactly the versions in constraints.txt

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "gsbake needs Python 3.11, 3.12 or 3.13, and none is on the PATH; name one: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	@"$(PYTHON)" -c '$(IN_RANGE)' || { echo "gsbake needs Python 3.11, 3.12 or 3.13 (xatlas has no wheel for newer ones); $(PYTHON) is `"$(PYTHON)" --version 2>&1`" >&2; exit 1; }
	@test -x $(BIN)/python || "$(PYTHON)" -m venv $(VENV) || { rm -rf $(VENV); echo "$(PYTHON) cannot make a virtual environment; on Debian: sudo apt-get install python3-venv" >&2; exit 1; }
	$(BIN)/python -m pip $(PIP_OPTIONS) $(TORCH)
	$(BIN)/python -m pip $(PIP_OPTIONS) --editable '.[dev]'
	@$(BIN)/python -W ignore -m compileall -qq -j 0 -x 'site-packages/.*/tests?/' "`$(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))'`" || true
	@$(BIN)/python -m gsbake.capture.masks.weights || echo "Without it masks are not made; everything else works." >&2
	@touch $@

node: $(VENV)/node/.stamp ## Install the JavaScript reference implementations that tests compare with

$(VENV)/node/.stamp: $(STAMP) tests/node/package-lock.json
	@mkdir -p $(VENV)/node && cp tests/node/package.json tests/node/package-lock.json $(VENV)/node
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/npm ci --prefix $(VENV)/node --silent --no-audit --no-fund
	@touch $@

demo: setup ## Bake the built-in capture with the smallest profile
	$(BIN)/gsbake synth $(DEMO_OUT)/capture
	$(BIN)/gsbake run $(DEMO_OUT)/capture --profile smoke --out $(DEMO_OUT)
	@echo "The asset is $(DEMO_OUT)/asset.glb; open $(DEMO_OUT)/report.html in a browser."

docs: setup ## Build the documentation into site/ (open site/index.html)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

lab: setup ## Write the tables of docs/lab from benchmarks/results
	$(BIN)/python -m benchmarks.lab

check: setup ## Lint and types
	$(BIN)/ruff check .
	$(BIN)/mypy

test: check node ## Lint, types and the quick tests, in two processes: WORKERS=2
	$(BIN)/pytest $(QUICK)

coverage: setup node ## The quick tests with the share of lines they run, which takes about half as long again
	$(BIN)/pytest $(QUICK) --cov --cov-report=term:skip-covered

stress: setup node ## The slow tests: hostile input at length, kills at random moments, faults on a Slurm cluster and on servers where installed, poses of a development capture where present
	GSBAKE_FUZZ_INPUTS=$(FUZZ_INPUTS) $(BIN)/pytest -m "slow or stress"

bench: setup ## Measure kernels, error against time (beside other tools) and growth, about two idle hours: PARTS="table timeline growth" ARGS=…
	@for part in $(PARTS); do $(BIN)/python -m benchmarks.$$part $(ARGS) || exit 1; done

score: .score/.stamp ## Score an asset against its truth: SCORE_GT=capture/gt SCORE_ASSET=asset.glb SCORE_ARGS=--no-render
	.score/bin/python $(SCORE_DIR)/score.py $(SCORE_GT) $(SCORE_ASSET) $(SCORE_ARGS)

.score/.stamp: $(SCORE_DIR)/requirements.txt
	@command -v python3.11 >/dev/null || { echo "the scorer needs Python 3.11, because Blender's module does" >&2; exit 1; }
	python3.11 -m venv .score
	.score/bin/python -m pip install --quiet --disable-pip-version-check -r $(SCORE_DIR)/requirements.txt
	@touch $@

$(SCORE_DIR)/requirements.txt:
	@echo "there is no scorer in $(SCORE_DIR); say where it is: make score SCORE_DIR=…" >&2; exit 1

lock: ## Write requirements.lock, the digests of every pinned package: WHEELS=DIR with PyTorch's CPU builds
	python3 packaging/lock.py $(if $(WHEELS),--wheels $(WHEELS))

audit: .audit/.stamp ## Look for risky code (bandit) and for known vulnerabilities of the pinned packages (pip-audit, needs the internet)
	.audit/bin/bandit -q -c pyproject.toml -r gsbake stages
	.audit/bin/pip-audit --disable-pip --require-hashes -r requirements.lock

sbom: setup .audit/.stamp ## Write out/sbom.json, the list of all installed packages and their licences (CycloneDX)
	@mkdir -p out
	.audit/bin/cyclonedx-py environment $(BIN)/python --of JSON -o out/sbom.json

.audit/.stamp: packaging/audit-requirements.txt
	@test -x .audit/bin/python || "$(PYTHON)" -m venv .audit
	.audit/bin/python -m pip install --quiet --disable-pip-version-check -r packaging/audit-requirements.txt
	@touch $@

clean: ## Delete the environments and caches (results in out/ stay)
	rm -rf $(VENV) .score .audit .mypy_cache .ruff_cache .pytest_cache .hypothesis dist site
	find gsbake stages profiles tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
