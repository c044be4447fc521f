# `make demo` shows it, `make test` checks it. Both make a virtual environment of their own, with uv
# where that is installed, and do only what is left to do.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

ifneq ($(shell command -v uv 2>/dev/null),)
new_venv = uv venv --quiet --allow-existing --python $(PYTHON) $(1)
install = uv pip install --quiet --python $(1)/bin/python
else
new_venv = $(PYTHON) -m venv $(1) && $(1)/bin/python -m pip install --quiet "pip>=25.1"
install = $(1)/bin/python -m pip install --quiet
endif

.DEFAULT_GOAL := help
.PHONY: help demo test format lint types imports unit own-coverage docs docs-serve bench soak fuzz test-wheel clean

help:  ## Say what there is
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1\t\2/p' Makefile | expand -t 20

demo: $(VENV)/.installed  ## Watch a Fibonacci goal: feedback, a cancel half-way, a result
	@$(BIN)/python examples/fibonacci_demo.py

test: lint types imports unit own-coverage docs  ## The whole check

format: $(VENV)/.tools  ## Lay out the code, and mend what can be mended
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

lint: $(VENV)/.tools
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: $(VENV)/.tools
	$(BIN)/mypy
	$(BIN)/basedpyright

imports: $(VENV)/.tools
	$(BIN)/lint-imports

unit: $(VENV)/.tools
	$(BIN)/coverage run -m pytest
	$(BIN)/coverage report --fail-under=100

own-coverage: $(VENV)/.tools  ## Is each module covered by its own test file?
	$(BIN)/python tests/own_coverage.py

docs: $(VENV)/.docs  ## Build the documentation into site/
	$(BIN)/python docs/build.py

docs-serve: $(VENV)/.docs  ## Show the documentation while it is written
	$(BIN)/zensical serve

bench: $(VENV)/.bench  ## Measure, and print JSON
	$(BIN)/python -m tests.benchmarks inprocess
	$(BIN)/python -m tests.benchmarks tcp

soak: $(VENV)/.tools  ## Fifty connections for ten minutes: does anything grow?
	$(BIN)/python -m tests.soak

fuzz: $(VENV)/.fuzz  ## Two minutes of bytes that mean no good
	$(BIN)/python -m tests.fuzz.wire -max_total_time=120

test-wheel: $(VENV)/.tools  ## Run the tests against the built wheel, from another folder
	rm -rf dist build/wheel
	$(BIN)/python -m build --quiet --wheel --outdir dist .
	$(call new_venv,build/wheel)
	$(call install,build/wheel) dist/*.whl --group test
	cd build && wheel/bin/python -m pytest -c ../pyproject.toml --rootdir .. -o pythonpath= \
	    -o cache_dir=build/.pytest_cache ../tests

clean:  ## Remove all that was made
	rm -rf $(VENV) .cache build dist site .coverage* .hypothesis .mypy_cache .pytest_cache .ruff_cache

$(VENV)/.made:
	$(call new_venv,$(VENV))
	@touch $@

$(VENV)/.installed: $(VENV)/.made pyproject.toml
	$(call install,$(VENV)) -e .
	@touch $@

$(VENV)/.tools: $(VENV)/.installed
	$(call install,$(VENV)) --group test --group check
	@touch $@

$(VENV)/.docs: $(VENV)/.tools
	$(call install,$(VENV)) --group docs
	@touch $@

$(VENV)/.fuzz: $(VENV)/.tools
	$(call install,$(VENV)) --group fuzz
	@touch $@

$(VENV)/.bench: $(VENV)/.tools
	$(call install,$(VENV)) --group bench
	@touch $@
