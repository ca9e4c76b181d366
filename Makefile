# Two commands are enough to start:
#
#   make demo    overlays of synthetic road scenes on disk, with the weights shipped in the package
#   make test    the test suite
#
# Each makes the virtual environment .venv if there is none, installs what it needs once, and runs.
# Variables: PYTHON (interpreter that makes .venv), TORCH (what pip installs PyTorch from), JOBS (test processes),
# PYTEST_ARGS (more options for pytest).

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Pinned, because pip takes a CPU build of exactly this version where one is at hand (see README, "PyTorch on a CPU").
TORCH ?= torch==2.13.0
JOBS ?= 2
PYTEST_ARGS ?=
DEMO ?= demo-output
# ExecuTorch is built for this version of PyTorch, which pip would install in place of another; without it its tests are skipped.
comma := ,
EXTRAS := all$(if $(filter torch==2.13%,$(TORCH)),$(comma)executorch)

INSTALL := $(BIN)/python -m pip --disable-pip-version-check install --quiet --no-compile
# On all cores, where pip compiles on one; some packages hold files for other versions of Python. Their tests stay.
COMPILE := $(BIN)/python -m compileall -q -j 0 -x 'site-packages/.*/tests?/' $(VENV)/lib > /dev/null 2>&1 || true
PYTORCH := $(VENV)/.installed-pytorch
RUNTIME := $(VENV)/.installed-runtime
DEVELOP := $(VENV)/.installed-develop
DOCUMENT := $(VENV)/.installed-docs

.DEFAULT_GOAL := help
.PHONY: help demo test lowest browser check format docs clean distclean

help: ## list the targets
	@awk -F':.*## ' '/^[a-z]+:.*## /{printf "make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: $(RUNTIME) ## draw the three tasks on synthetic scenes, into demo-output/
	@rm -rf $(DEMO)
	$(BIN)/trilitenet data synthesize $(DEMO)/scenes --count 8 --seed 0
	$(BIN)/trilitenet predict $(DEMO)/scenes/images/train --output $(DEMO)/overlays
	@echo
	@echo "Overlays and JSON: $(abspath $(DEMO)/overlays)"
	@echo "Your own picture:  $(BIN)/trilitenet predict PHOTO.jpg --output results"

test: $(DEVELOP) ## run the test suite
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) $(PYTEST_ARGS)

lowest: ## run the test suite with the oldest versions that pyproject.toml allows, in .venv-lowest
	$(MAKE) VENV=.venv-lowest .venv-lowest/bin/python
	.venv-lowest/bin/python -m pip --disable-pip-version-check install --quiet uv
	.venv-lowest/bin/uv pip install --quiet --python .venv-lowest/bin/python --resolution lowest-direct --editable ".[all,dev]"
	OMP_NUM_THREADS=1 .venv-lowest/bin/python -m pytest -n $(JOBS) $(PYTEST_ARGS)

browser: ## install Chromium for the tests of the page (Debian, Ubuntu; as root); without it they are skipped
	apt-get update -qq
	DEBIAN_FRONTEND=noninteractive apt-get install -qq --yes --no-install-recommends chromium chromium-driver

check: $(DEVELOP) ## lint, formatting, types and layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(DEVELOP) ## format the code and fix what the linter can
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

docs: $(DOCUMENT) ## build the documentation into site/
	$(BIN)/mkdocs build --strict

clean: ## remove what demo, tests and builds left
	rm -rf $(DEMO) build dist site .coverage .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true

distclean: clean ## clean, and remove the virtual environment
	rm -rf $(VENV) .venv-lowest

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null || { \
		echo "error: $(PYTHON) is missing or older than Python 3.10; install it (Debian, Ubuntu: apt install python3)" \
			"or name another: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
		echo "error: $(PYTHON) cannot make virtual environments; on Debian or Ubuntu: apt install python3-venv" >&2; \
		exit 1; }
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

$(PYTORCH): | $(BIN)/python
	$(INSTALL) "$(TORCH)"
	@touch $@

$(RUNTIME): pyproject.toml $(PYTORCH)
	$(INSTALL) --editable ".[video,heic]"
	@$(COMPILE)
	@touch $@

$(DEVELOP): pyproject.toml $(PYTORCH)
	$(INSTALL) --editable ".[$(EXTRAS),dev]"
	@$(COMPILE)
	@touch $(RUNTIME) $@

$(DOCUMENT): $(RUNTIME)
	$(INSTALL) --editable ".[docs]"
	@$(COMPILE)
	@touch $@
