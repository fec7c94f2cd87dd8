# Everything a person or CI does with this tree.  `make` alone lists the targets.

# The interpreter that .venv is made with; at least 3.11.
PYTHON ?= python3
# How long the demo runs; empty means until Ctrl-C.
SECONDS ?=
# More arguments for pytest or the benchmark: make test ARGS="-k codec".
ARGS ?=

BIN := .venv/bin
# A new source is compiled by installing the project again.
COMPILED := $(wildcard eap/cyclic/*.[ch]) tools/package/compiled.py

# Where it is set, each process of an appliance would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup demo valve test test-pure test-tools test-package fuzz properties check structure bench dist deb clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' Makefile

setup: .venv/.stamp-dev  ## prepare .venv for tests and checks (once, and when pyproject.toml changes)

# What runs the appliance; neither stamp depends on the other, for the second covers both.
.venv/.stamp-run: pyproject.toml $(COMPILED)
	@PYTHON='$(PYTHON)' sh tools/venv.sh run

.venv/.stamp-dev: pyproject.toml $(COMPILED)
	@PYTHON='$(PYTHON)' sh tools/venv.sh dev

.venv/.stamp-bench: .venv/.stamp-dev
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --group bench \
		|| echo 'make bench: going on; peers that are missing are left out'
	@touch $@

demo: .venv/.stamp-run  ## run the demo plant and show its values moving; Ctrl-C ends it
	@$(BIN)/python tools/demo.py $(if $(SECONDS),--seconds '$(SECONDS)')

valve: .venv/.stamp-run  ## a limit switch on one station's bus opens a valve on another's, through EAP
	@$(BIN)/python tools/valve_demo.py

# Each worker has a network of its own, as an ordinary user in a user namespace where these are allowed; tests marked quiet run alone: see tests/conftest.py.
PYTEST := sh tools/isolated.sh $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

test: setup  ## run all tests of the product; as root, first install the programs they use
	@sh tools/install_peers.sh test || echo 'make test: going on; what needs them is skipped and listed'
	@$(PYTEST) --ignore=tests/tools --ignore=tests/package $(ARGS)

test-pure: setup  ## run the tests of the cyclic path without its compiled part
	@EAP_PURE=1 $(PYTEST) tests/unit/eap/pd tests/unit/eap/net tests/unit/eap/engine tests/unit/devicebus $(ARGS)

test-tools: setup  ## run the tests of tools/: fuzz targets, page of faults, benchmarks
	@$(PYTEST) tests/tools $(ARGS)

# The wheel is built from the commit; its time is that of all files.
dist: setup  ## build wheel and archive of sources in dist/
	@rm -rf dist && SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(BIN)/hatchling build --directory dist

deb: dist  ## build the Debian package in dist/, for the Python of this Debian
	@$(BIN)/python -m tools.package.deb dist/*.whl dist

test-package: deb  ## test wheel, Debian package and image (as root: in a clean Debian, made by debootstrap)
	@sh tools/install_peers.sh package || echo 'make test-package: going on; what needs them is skipped and listed'
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --group deploy || echo 'make test-package: going on without Ansible'
	@$(BIN)/python -m pytest tests/package $(ARGS)

fuzz: setup  ## damage messages to each decoder and listening socket for SECONDS (10) each; finds are kept in .fuzz
	@sh tools/isolated.sh $(BIN)/python -m tools.fuzz $(if $(SECONDS),--seconds '$(SECONDS)') $(ARGS)

properties: setup  ## run the property tests with all their examples; make test takes a tenth
	@$(PYTEST) -m hypothesis --hypothesis-profile=full tests $(ARGS)

check: setup  ## format, lint, types, import contracts, tree, and whether each test can be imported
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/python tools/check_tree.py
	$(BIN)/python -m tools.schema --check
	@found=$$($(BIN)/python -m pytest --collect-only -qqq tests 2>&1) || { echo "$$found"; exit 1; }

structure: setup  ## count modules, code lines, names, tests, and modules that a request passes (up to a minute)
	@sh tools/isolated.sh $(BIN)/python -m tools.structure --paths $(ARGS)

bench: .venv/.stamp-bench  ## measure speed and memory (as root for everything; takes minutes)
	@sh tools/install_peers.sh bench || echo 'make bench: going on without; what needs them is left out'
	@$(BIN)/python -m tools.bench $(ARGS)

clean:  ## remove .venv and everything that was generated
	rm -rf .venv build dist *.egg-info .coverage .hypothesis .import_linter_cache \
		.mypy_cache .pytest_cache .ruff_cache tests/peers/node_modules
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
