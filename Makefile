# `make demo` shows it, `make test` checks it. Both make a virtual environment, with uv if it is
# installed, and skip the steps that are up to date.

PYTHON ?= python3
# The amount of work of `make bench`: less is faster, and less exact.
SCALE ?= 1
VENV := .venv
BIN := $(VENV)/bin

# mutmut has an environment of its own, since the tests must pass without its dependencies.
MUTANTS_VENV := .venv-mutants

# ROS 2 has a virtual environment of its own: its wheels start each Python of theirs twice.
ROS_VENV := .venv-ros
ROS_BIN := $(ROS_VENV)/bin
INTERFACES := examples/ros2/arduinobot_msgs tests/ros2/fibaction_test_msgs
# The tests use this environment, and not a ROS that was sourced in the shell.
no_other_ros = env -u AMENT_PREFIX_PATH -u PYTHONPATH -u RMW_IMPLEMENTATION

ifneq ($(shell command -v uv 2>/dev/null),)
new_venv = uv venv --quiet --allow-existing --python $(PYTHON) $(1)
install = uv pip install --quiet --python $(1)/bin/python
else
new_venv = $(PYTHON) -m venv $(1) && $(1)/bin/python -m pip install --quiet "pip>=25.1"
install = $(1)/bin/python -m pip install --quiet
endif

# The tests start hundreds of processes, and each would compile all modules anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test format lint types imports unit docs docs-serve bench simulate soak kills fleet fuzz attack mutants test-ros test-wheel test-pythons test-lowest ros clean

help:  ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1\t\2/p' Makefile | expand -t 20

demo: $(VENV)/.installed  ## Run a Fibonacci goal: feedback, a cancel half-way, a result
	@$(BIN)/python examples/fibonacci_demo.py

test: lint types imports unit docs  ## Run all checks, with ROS 2 if it is available
	@why=$$($(PYTHON) examples/ros2/build_interfaces.py --platform); if [ -z "$$why" ]; \
	    then $(MAKE) --no-print-directory test-ros; else echo "test-ros is left out: $$why"; fi

format: $(VENV)/.tools  ## Format the code, and fix what ruff can fix
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
	$(no_other_ros) $(BIN)/python -m pytest -p tests.own_coverage -n auto --dist worksteal

docs: $(VENV)/.docs  ## Build the documentation into site/
	$(BIN)/python docs/build.py

docs-serve: $(VENV)/.docs  ## Serve the documentation, rebuilt at each change
	$(BIN)/python -m tests.promises
	$(BIN)/zensical serve

# Servers of NATS and of Redis are unpacked rather than installed: as packages, they would start
# services.
bench: $(VENV)/.bench  ## Measure everything beside its peers, for docs/comparisons.md
	@cd $(VENV) && which nats-server >/dev/null || [ -d nats ] || ! which apt-get >/dev/null || \
	    { apt-get download -qq nats-server 2>/dev/null && dpkg -x nats-server_*.deb nats; } || true
	@cd $(VENV) && which redis-server >/dev/null || [ -d redis ] || ! which apt-get >/dev/null || \
	    { apt-get download -qq redis-server redis-tools libjemalloc2 liblzf1 2>/dev/null && \
	    for package in redis-*.deb libjemalloc2_*.deb liblzf1_*.deb; do dpkg -x $$package redis; done; } || true
	$(no_other_ros) $(BIN)/python -m tests.benchmarks all --scale $(SCALE)
	$(BIN)/python -m tests.benchmarks.durable
	$(BIN)/python -m tests.benchmarks.fleet

simulate: $(VENV)/.tools  ## Run random scenarios in virtual time for ten minutes
	$(BIN)/python -m tests.simulation --seconds 600

soak: $(VENV)/.tools  ## Run fifty connections for ten minutes, and check that nothing grows
	$(BIN)/python -m tests.soak

kills: $(VENV)/.tools  ## Kill a server that keeps its goals, for two minutes twice, and start it again
	$(BIN)/python -m tests.kills --seconds 120 --clients 20
	$(BIN)/python -m tests.kills --seconds 120 --clients 20 --recovery rerun

fleet: $(VENV)/.tools  ## Kill and freeze workers and brokers of a fleet, ten times each
	$(BIN)/python -m tests.fleet all --times 10

fuzz: $(VENV)/.fuzz  ## Send random bytes to a server for two minutes
	$(BIN)/python -m tests.fuzz.wire -max_total_time=120

attack: $(VENV)/.tools  ## Attack a server in every way, for 20 seconds each, beside an honest client
	$(BIN)/python -m tests.hostile

mutants: $(MUTANTS_VENV)/.installed  ## Put small faults into the rules, and check that the tests find each
	$(MUTANTS_VENV)/bin/python -m tests.mutants

# The wheel is made from the sdist, as packagers do; and from the checkout, to compare. The attacks,
# the kills and the fleet are left out: their servers are forked from a process that knows the checkout only.
test-wheel: $(VENV)/.release  ## Check the sdist and the wheel, and run the tests against the wheel
	rm -rf dist build/checkout build/consumer build/wheel
	$(BIN)/python -m build --quiet --outdir dist .
	$(BIN)/python -m build --quiet --outdir build/checkout --wheel .
	$(BIN)/python -m twine check --strict dist/*
	$(call new_venv,build/consumer)
	$(call install,build/consumer) dist/*.whl
	FIBACTION_BUILT=1 $(BIN)/python -m pytest tests/packaging
	$(call new_venv,build/wheel)
	$(call install,build/wheel) dist/*.whl --group test
	cd build && $(no_other_ros) wheel/bin/python -m pytest -n auto --dist worksteal -c ../pyproject.toml --rootdir .. -o pythonpath= \
	    -o cache_dir=build/.pytest_cache ../tests \
	    --ignore=../tests/hostile --ignore=../tests/kills --ignore=../tests/fleet

# The versions in pyproject.toml that `make test` does not use.
PYTHONS = $(filter-out $(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])'),3.11 3.12 3.13)
# Property tests need few examples to find differences between versions of Python and of libraries,
# and coverage is measured in .venv only. The trials of fleets are of brokers and of processes.
test_elsewhere = FIBACTION_EXAMPLES=20 $(no_other_ros) $(1)/bin/python -m pytest -q -n auto --dist worksteal \
    -o cache_dir=$(1)/.pytest_cache $(ELSEWHERE)
ELSEWHERE := tests --ignore=tests/test_own_coverage.py --ignore=tests/fleet

test-pythons:  ## Run the tests with each other version of Python that is installed
	@for version in $(PYTHONS); do \
	    if ! python=$$(tests/find_python.sh $$version); \
	    then echo "Python $$version is left out: it is not here"; \
	    else $(MAKE) --no-print-directory test-python$$version PYTHON=$$python || exit; fi; \
	done

test-python%: build/python%/.installed
	$(call test_elsewhere,build/python$*)

test-lowest: build/lowest/.installed  ## Run the tests with the lowest versions of libraries that are allowed
	$(call test_elsewhere,build/lowest)

# `timeout` ends a process that hangs despite the timeouts of the tests. The tests wait for other
# processes half of the time, so two of them run at once.
test-ros: $(ROS_VENV)/.interfaces  ## Test the ROS 2 transport with ROS 2, from wheels
	rm -f .coverage-ros .coverage-ros.*
	FIBACTION_ROS=required COVERAGE_PROCESS_START=tests/ros2/coverage.toml COVERAGE_FILE=.coverage-ros \
	    $(no_other_ros) timeout --foreground --kill-after=10 1200 \
	    $(ROS_BIN)/python -m pytest tests/ros2 -n 2 --dist loadfile \
	    -o faulthandler_timeout=75 -o faulthandler_exit_on_timeout=true
	$(ROS_BIN)/python -m coverage combine --quiet --data-file=.coverage-ros
	$(ROS_BIN)/python -m coverage report --data-file=.coverage-ros \
	    --include='*/fibaction_transports/ros2/*' --fail-under=100

ros: $(ROS_VENV)/.interfaces  ## Make .venv-ros: ROS 2 from wheels, and the interfaces used here

clean:  ## Remove all generated files
	rm -rf $(VENV) $(MUTANTS_VENV) $(ROS_VENV) .cache build dist site .coverage* .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -prune -exec rm -r {} +

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

$(VENV)/.release: $(VENV)/.tools
	$(call install,$(VENV)) --group release
	@touch $@

$(VENV)/.fuzz: $(VENV)/.tools
	$(call install,$(VENV)) --group fuzz
	@touch $@

$(MUTANTS_VENV)/.made:
	$(call new_venv,$(MUTANTS_VENV))
	@touch $@

$(MUTANTS_VENV)/.installed: $(MUTANTS_VENV)/.made pyproject.toml
	$(call install,$(MUTANTS_VENV)) -e . --group test --group mutants
	@touch $@

$(VENV)/.bench: $(VENV)/.tools
	$(call install,$(VENV)) --group bench
	@touch $@

.PRECIOUS: build/python%/.installed
build/python%/.installed: pyproject.toml
	rm -rf $(@D)
	mkdir -p build
	$(call new_venv,$(@D))
	$(call install,$(@D)) -e '.[uvloop]' --group test
	@touch $@

build/lowest/.installed: pyproject.toml tests/lowest.py
	rm -rf $(@D)
	mkdir -p build
	$(call new_venv,$(@D))
	$(PYTHON) -m tests.lowest > $(@D)/lowest.txt
	$(call install,$(@D)) -e '.[uvloop]' --group test --constraint $(@D)/lowest.txt
	@touch $@

$(ROS_VENV)/.made:
	$(call new_venv,$(ROS_VENV))
	@touch $@

$(ROS_VENV)/.installed: $(ROS_VENV)/.made pyproject.toml
	$(call install,$(ROS_VENV)) -e . --group test --group ros
	@cd $(ROS_VENV) && ls -d lib/python*/site-packages/ros_*.dist-info >.found && \
	    { cmp -s .found .wheels || mv .found .wheels; }
	@touch $@

# The list of wheels. It changes only if they do, and then interfaces are built again.
$(ROS_VENV)/.wheels: $(ROS_VENV)/.installed
	@:

$(ROS_VENV)/.interfaces: $(ROS_VENV)/.wheels examples/ros2/build_interfaces.py \
    $(shell find $(INTERFACES) -type f)
	@which cc c++ >/dev/null || [ "$$(id -u)" != 0 ] || ! which apt-get >/dev/null || \
	    { apt-get update -qq && apt-get install -yqq g++; }
	$(no_other_ros) $(ROS_BIN)/python examples/ros2/build_interfaces.py $(INTERFACES)
	@touch $@
