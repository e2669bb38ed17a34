# gsbake: everything sets itself up in .venv; nothing but Python 3.11–3.13 is needed beforehand.
#   make PYTHON=/path/to/python3.12 …   chooses the Python
#   make DEMO_OUT=… demo                chooses where the demo goes

SHELL := /bin/sh
VENV := .venv
BIN := $(VENV)/bin
RUNTIME := $(VENV)/.runtime
DEV := $(VENV)/.dev
IN_RANGE := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3 python; do \
	command -v $$p >/dev/null 2>&1 && $$p -c '$(IN_RANGE)' 2>/dev/null && echo $$p && break; done)
TORCH := $(shell grep '^torch==' constraints.txt)
# PyTorch's builds for the CPU. The plain wheel of the package index brings gigabytes of CUDA on Linux; for a GPU: TORCH_INDEX=https://download.pytorch.org/whl/cu130
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
# Byte code is compiled when a module is first imported, as most of what is installed never is, and kept, as every stage is a process of its own.
unexport PYTHONDONTWRITEBYTECODE
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
DEMO_OUT ?= out/demo

# Make a virtual environment $(1) with the Python $(2), unless it is there. A folder that holds anything else is refused, and what was there stays.
define make_environment
test -x "$(1)/bin/python" || { \
	test -f "$(1)/pyvenv.cfg" || test -z "`ls -A "$(1)" 2>/dev/null`" || { echo "$(1) is no virtual environment, and not empty; name another folder" >&2; exit 1; }; \
	new=; test -e "$(1)" || test -L "$(1)" || new="$(1)"; \
	"$(2)" -m venv "$(1)" || { test -z "$$new" || rm -rf "$$new"; echo "$(2) cannot make a virtual environment; on Debian: sudo apt-get install python3-venv" >&2; exit 1; }; }
endef

LOCK := --config-file packaging/uv.toml --universal --python-version 3.11.5 --generate-hashes --constraint constraints.txt \
	--no-emit-package torch --no-header --no-annotate

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

.PHONY: help setup kernels node demo docs lab test coverage check bench stress score lock audit sbom clean

help: ## Show this
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 10

setup: $(DEV) ## Make .venv with everything for developers, exactly the versions in constraints.txt

$(RUNTIME): pyproject.toml constraints.txt packaging/runtime.lock
	@test -n "$(PYTHON)" || { echo "gsbake needs Python 3.11, 3.12 or 3.13, and none is on the PATH; name one: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	@"$(PYTHON)" -c '$(IN_RANGE)' || { echo "gsbake needs Python 3.11, 3.12 or 3.13 (xatlas has no wheel for newer ones); $(PYTHON) is `"$(PYTHON)" --version 2>&1`" >&2; exit 1; }
	@$(call make_environment,$(VENV),$(PYTHON))
	$(PIP) --no-deps --require-hashes --requirement packaging/runtime.lock
	@echo "Installing PyTorch from $(TORCH_INDEX)"
	@$(PIP) --index-url $(TORCH_INDEX) --retries 1 $(TORCH) || { echo "PyTorch is not to be had from $(TORCH_INDEX); name a mirror of it: make TORCH_INDEX=https://… (https://pypi.org/simple brings gigabytes of CUDA libraries on Linux)" >&2; exit 1; }
	$(PIP) --no-deps --no-build-isolation --editable .
	@$(BIN)/gsbake doctor --fetch-weights || echo "Without it masks are not made; everything else works." >&2
	@touch $@

$(DEV): $(RUNTIME) packaging/dev.lock
	$(PIP) --no-deps --require-hashes --requirement packaging/dev.lock
	@touch $@

node: $(VENV)/node/.stamp ## Install the JavaScript reference implementations that tests compare with

$(VENV)/node/.stamp: $(DEV) tests/node/package-lock.json
	@mkdir -p $(VENV)/node && cp tests/node/package.json tests/node/package-lock.json $(VENV)/node
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/npm ci --prefix $(VENV)/node --silent --no-audit --no-fund
	@touch $@

demo: $(RUNTIME) ## Bake the built-in capture with the smallest profile
	$(BIN)/gsbake synth $(DEMO_OUT)/capture
	$(BIN)/gsbake run $(DEMO_OUT)/capture --profile smoke --out $(DEMO_OUT)
	@echo "The asset is $(DEMO_OUT)/asset.glb; open $(DEMO_OUT)/report.html in a browser."

docs: setup ## Build the documentation into site/ (open site/index.html)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

lab: setup ## Write the tables of docs/lab from benchmarks/results
	$(BIN)/python -m benchmarks.lab

# The types of everything for this system, and for macOS and Windows of what depends on the system (tests/system/test_one_place.py keeps it
# there). Caches apart, or each would throw the others' away.
check: setup ## Lint, types on three systems, order of the layers, dead code
	$(BIN)/ruff check .
	$(BIN)/mypy
	@for system in darwin win32; do $(BIN)/mypy --platform $$system --cache-dir .mypy_cache/$$system -p gsbake.system -p gsbake.pipeline \
		-m gsbake.limited_process -m gsbake.capture.sfm.process || exit 1; done
	$(BIN)/lint-imports --no-logo --no-cache
	$(BIN)/vulture

# The checks use one core and compiling kernels waits for its slowest one, so that both go on at once.
test: setup node ## The checks and the quick tests, in two processes: WORKERS=2
	@$(MAKE) --no-print-directory --jobs 2 kernels check
	$(BIN)/pytest $(QUICK)

# Compiled here by all cores, or every process of the tests would compile what it needs.
kernels: $(RUNTIME)
	@$(BIN)/python -m gsbake.cli.kernels

coverage: kernels setup node ## The quick tests with the share of lines they run, which takes about half as long again
	$(BIN)/pytest $(QUICK) --cov --cov-report=term:skip-covered

stress: setup node ## The slow tests: hostile input at length, 200 photos of 24 megapixels (GSBAKE_LARGE_PHOTOS=N), kills at random moments, faults on a Slurm cluster and on servers where installed, poses of a development capture where present
	GSBAKE_FUZZ_INPUTS=$(FUZZ_INPUTS) $(BIN)/pytest -m "slow or stress"

bench: setup ## Measure kernels, error against time (beside other tools) and growth, about two idle hours: PARTS="table timeline growth" ARGS=…
	@for part in $(PARTS); do $(BIN)/python -m benchmarks.$$part $(ARGS) || exit 1; done

score: .score/.stamp ## Score an asset against its truth: SCORE_GT=capture/gt SCORE_ASSET=asset.glb SCORE_ARGS=--no-render
	.score/bin/python $(SCORE_DIR)/score.py $(SCORE_GT) $(SCORE_ASSET) $(SCORE_ARGS)

.score/.stamp: $(SCORE_DIR)/requirements.txt
	@command -v python3.11 >/dev/null || { echo "the scorer needs Python 3.11, because Blender's module does" >&2; exit 1; }
	@$(call make_environment,.score,python3.11)
	.score/bin/python -m pip install --quiet --disable-pip-version-check -r $(SCORE_DIR)/requirements.txt
	@touch $@

$(SCORE_DIR)/requirements.txt:
	@echo "there is no scorer in $(SCORE_DIR); say where it is: make score SCORE_DIR=…" >&2; exit 1

# Locked for all three systems and all Pythons; PyTorch is left to its version in constraints.txt (see packaging/uv.toml).
lock: .audit/.stamp ## Write packaging/*.lock, the digests of every file of the pinned packages
	.audit/bin/uv pip compile --quiet $(LOCK) --output-file packaging/runtime.lock pyproject.toml packaging/build.in
	.audit/bin/uv pip compile --quiet $(LOCK) --output-file packaging/dev.lock --extra dev pyproject.toml packaging/build.in

audit: .audit/.stamp ## Look for risky code (bandit) and for known vulnerabilities of the pinned packages (pip-audit, needs the internet)
	.audit/bin/bandit -q -c pyproject.toml -r gsbake stages
	.audit/bin/pip-audit --disable-pip --require-hashes -r packaging/dev.lock

sbom: setup .audit/.stamp ## Write out/sbom.json, the list of all installed packages and their licences (CycloneDX)
	@mkdir -p out
	.audit/bin/cyclonedx-py environment $(BIN)/python --of JSON -o out/sbom.json

.audit/.stamp: packaging/audit-requirements.txt
	@$(call make_environment,.audit,$(PYTHON))
	.audit/bin/python -m pip install --quiet --disable-pip-version-check -r packaging/audit-requirements.txt
	@touch $@

clean: ## Delete the environments and caches (results in out/ stay)
	@for folder in "$(VENV)" .score .audit; do \
		if test -f "$$folder/pyvenv.cfg"; then rm -rf "$$folder"; \
		elif test -e "$$folder"; then echo "$$folder is no virtual environment and stays" >&2; fi; done
	rm -rf .mypy_cache .ruff_cache .pytest_cache .hypothesis dist site
	find gsbake stages profiles tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
