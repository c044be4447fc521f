# `make demo` shows it, `make test` checks it. Both make a virtual environment of their own, with uv
# where that is installed, and do only what is left to do.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# ROS 2 has a virtual environment of its own: its wheels start each Python of theirs twice.
ROS_VENV := .venv-ros
ROS_BIN := $(ROS_VENV)/bin
INTERFACES := examples/ros2/arduinobot_msgs tests/ros2/fibaction_test_msgs
# It is the wheels that are tested, not a ROS that the shell has been told of.
no_other_ros = env -u AMENT_PREFIX_PATH -u PYTHONPATH -u RMW_IMPLEMENTATION

ifneq ($(shell command -v uv 2>/dev/null),)
new_venv = uv venv --quiet --allow-existing --python $(PYTHON) $(1)
install = uv pip install --quiet --python $(1)/bin/python
else
new_venv = $(PYTHON) -m venv $(1) && $(1)/bin/python -m pip install --quiet "pip>=25.1"
install = $(1)/bin/python -m pip install --quiet
endif

.DEFAULT_GOAL := help
.PHONY: help demo test format lint types imports unit own-coverage docs docs-serve bench soak fuzz test-ros test-wheel ros clean

help:  ## Say what there is
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1\t\2/p' Makefile | expand -t 20

demo: $(VENV)/.installed  ## Watch a Fibonacci goal: feedback, a cancel half-way, a result
	@$(BIN)/python examples/fibonacci_demo.py

test: lint types imports unit own-coverage docs  ## The whole check, with ROS 2 where it can be had
	@why=$$($(PYTHON) examples/ros2/build_interfaces.py --platform); if [ -z "$$why" ]; \
	    then $(MAKE) --no-print-directory test-ros; else echo "test-ros is left out: $$why"; fi

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
	$(BIN)/pytest -n auto --dist worksteal

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
	cd build && wheel/bin/python -m pytest -n auto --dist worksteal -c ../pyproject.toml --rootdir .. -o pythonpath= \
	    -o cache_dir=build/.pytest_cache ../tests

# `timeout` is for a process that does not even end by what the tests have against hanging. The tests
# spend half of their time waiting for other processes, so two of them run at once.
test-ros: $(ROS_VENV)/.interfaces  ## Test the ROS 2 transport with ROS 2, from wheels
	rm -f .coverage-ros .coverage-ros.*
	FIBACTION_ROS=required COVERAGE_PROCESS_START=tests/ros2/coverage.toml COVERAGE_FILE=.coverage-ros \
	    $(no_other_ros) timeout --foreground --kill-after=10 1200 \
	    $(ROS_BIN)/python -m pytest tests/ros2 -n 2 --dist loadfile \
	    -o faulthandler_timeout=180 -o faulthandler_exit_on_timeout=true
	$(ROS_BIN)/python -m coverage combine --quiet --data-file=.coverage-ros
	$(ROS_BIN)/python -m coverage report --data-file=.coverage-ros \
	    --include='*/fibaction_transports/ros2/*' --fail-under=100

ros: $(ROS_VENV)/.interfaces  ## Make .venv-ros: ROS 2 from wheels, and the interfaces used here

clean:  ## Remove all that was made
	rm -rf $(VENV) $(ROS_VENV) .cache build dist site .coverage* .hypothesis .mypy_cache .pytest_cache .ruff_cache

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

$(ROS_VENV)/.made:
	$(call new_venv,$(ROS_VENV))
	@touch $@

$(ROS_VENV)/.installed: $(ROS_VENV)/.made pyproject.toml
	$(call install,$(ROS_VENV)) -e . --group test --group ros
	@cd $(ROS_VENV) && ls -d lib/python*/site-packages/ros_*.dist-info >.found && \
	    { cmp -s .found .wheels || mv .found .wheels; }
	@touch $@

# Which wheels there are. It changes only if they do, and then interfaces are built again.
$(ROS_VENV)/.wheels: $(ROS_VENV)/.installed
	@:

$(ROS_VENV)/.interfaces: $(ROS_VENV)/.wheels examples/ros2/build_interfaces.py \
    $(shell find $(INTERFACES) -type f)
	@which cc c++ >/dev/null || [ "$$(id -u)" != 0 ] || ! which apt-get >/dev/null || \
	    { apt-get update -qq && apt-get install -yqq g++; }
	$(no_other_ros) $(ROS_BIN)/python examples/ros2/build_interfaces.py $(INTERFACES)
	@touch $@
