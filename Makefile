# `make demo` shows it, `make test` checks it. Both make a virtual environment, with uv if it is
# installed, and skip the steps that are up to date. The parts of the checks are in tests/tools.

export PYTHON ?= python3
# The amount of work of `make bench`: less is faster, and less exact.
SCALE ?= 1
# The minutes of `make simulate`.
MINUTES ?= 10
# The release of ROS 2, kilted or jazzy.
ROS ?= kilted

VENV := .venv
BIN := $(VENV)/bin
ROS_VENV := .venv-$(if $(filter kilted,$(ROS)),ros,ros-$(ROS))

# The tests use the ROS of their environment, and not one that was sourced in the shell.
no_other_ros = env -u AMENT_PREFIX_PATH -u PYTHONPATH -u RMW_IMPLEMENTATION
pytest = $(no_other_ros) $(BIN)/python -m pytest -q
# Many tests wait for timeouts, so three of them share two cores.
export PYTEST_XDIST_AUTO_NUM_WORKERS ?= $(shell echo $$(( ($$(getconf _NPROCESSORS_ONLN) * 3 + 1) / 2 )))
at_once = -n auto --dist worksteal
# The tests start hundreds of processes, and each would compile all modules anew.
unexport PYTHONDONTWRITEBYTECODE
MAKEFLAGS += --no-print-directory
.PHONY: help demo check test elsewhere format lint types imports unit programs get docs docs-serve \
    test-ros test-wheel test-pythons test-lowest openapi agents frontends bench regression simulate contract \
    properties soak kills lossy fleet fuzz attack mutants release lock audit ros clean

help:  ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1\t\2/p' Makefile | expand -t 20

demo: $(VENV)/.installed  ## Run a Fibonacci goal: feedback, a cancel half-way, a result
	@$(BIN)/python examples/fibonacci_demo.py

# The checks

# The rules without I/O, both ends of an action, and what the project says of itself.
QUICK := $(addprefix tests/,server wire interfaces words types client test_api.py test_contributing.py \
    test_init.py test_project.py test_structure.py test_style.py test_answers.py)
check: lint imports $(VENV)/.tools  ## Run the quick checks, in less than a minute
	$(BIN)/mypy fibaction transports
	$(pytest) $(at_once) $(QUICK)

# The unit tests wait half of the time, so the other checks run beside them.
test: lint $(VENV)/.docs build/javascript/.installed get  ## Run all checks but `elsewhere`
	@MAKE="$(MAKE)" $(PYTHON) -m tests.tools.beside unit "imports types docs programs"

# One after the other, since tests with ROS 2 wait for real time.
elsewhere:  ## Run the tests with ROS 2, with the wheel, the other Pythons and the lowest versions
	@$(MAKE) test-ros ROS=kilted
	@$(MAKE) test-ros ROS=jazzy
	@$(MAKE) test-wheel
	@$(no_other_ros) tests/tools/elsewhere.sh lowest pythons

format: $(VENV)/.tools  ## Format the code, and fix what ruff can fix
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

lint: $(VENV)/.tools  ## Check the format of the code, and what ruff finds
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: $(VENV)/.tools  ## Check the types of the code, and of the programs in the pages
	$(BIN)/mypy
	$(BIN)/basedpyright
	$(BIN)/python -m tests.typing.pages
	$(BIN)/python -m tests.typing.other_checkers

imports: $(VENV)/.tools  ## Check that imports point one way
	$(BIN)/lint-imports

# The tests that start processes, and wait for what these do in real time.
PROGRAMS := $(addprefix tests/,browser fleet kills lossy soak \
    support/test_walks.py test_examples.py test_stories.py)

unit: $(VENV)/.tools build/javascript/.installed get  ## Run the tests, and look at what they cover
	$(pytest) -p tests.tools.own_coverage $(at_once) --durations=25 $(addprefix --ignore=,$(PROGRAMS))

programs: $(VENV)/.tools build/javascript/.installed get  ## Run the tests of whole programs
	$(pytest) --durations=10 $(PROGRAMS)

get: $(VENV)/.tools  ## Get the browser and the checker of metrics that tests use, where this user may
	@tests/tools/get.sh chromium
	@tests/tools/get.sh promtool

docs: $(VENV)/.docs  ## Build the documentation into site/
	$(BIN)/python docs/build.py

docs-serve: $(VENV)/.docs  ## Serve the documentation, rebuilt at each change
	$(BIN)/python -m tests.tools.promises
	$(BIN)/zensical serve

# The checks with other versions. What they leave out, and why, is in tests/tools/elsewhere.py.

test-ros: ros  ## Test the ROS 2 transport with ROS 2 Kilted, or with ROS=jazzy
	$(no_other_ros) tests/ros2/check.sh $(ROS_VENV)

test-wheel: $(VENV)/.release  ## Check the sdist and the wheel, and run the tests against the wheel
	$(no_other_ros) tests/packaging/check.sh

test-pythons:  ## Run the tests with each other version of Python that is installed
test-lowest:  ## Run the tests with the lowest versions of libraries that are allowed
test-pythons test-lowest:
	@$(no_other_ros) tests/tools/elsewhere.sh $(@:test-%=%)

openapi: $(VENV)/.tools  ## Try the programs of others for OpenAPI at a server: clients, random requests
agents: $(VENV)/.tools  ## Try agents of others at a bridge: MCP's suite, fastmcp, google-adk, strands
frontends: $(VENV)/.tools  ## Try the hooks of examples/web in React, Vue and Svelte; Deno and Bun
openapi agents frontends:
	$(no_other_ros) tests/tools/others.sh $@

# The trials of each night, and the measurements

bench: $(VENV)/.bench  ## Measure everything beside its peers, for docs/comparisons.md
	$(no_other_ros) tests/tools/benchmarks/all.sh $(SCALE)

regression: $(VENV)/.tools  ## Fail if it is 15 % slower than yesterday, or BASE=COMMIT
	$(BIN)/python -m tests.tools.benchmarks.regression --base "$(BASE)"

simulate: $(VENV)/.tools  ## Run random scenarios in virtual time for ten minutes, or MINUTES=60
	$(BIN)/python -m tests.simulation --seconds $$(( $(MINUTES) * 60 ))

contract: $(VENV)/.tools  ## Run each test of the contract over each transport, on asyncio and on trio
	FIBACTION_CONTRACT=whole $(pytest) $(at_once) tests/contract

properties: $(VENV)/.tools  ## Run the property tests with a thousand examples each
	FIBACTION_EXAMPLES=1000 $(pytest) $(at_once) -m hypothesis --timeout 1800

soak: $(VENV)/.tools  ## Run fifty connections for ten minutes, alone and beside load: nothing grows
kills: $(VENV)/.tools  ## Kill a server that keeps its goals, for two minutes twice, and start it again
lossy: $(VENV)/.tools  ## Send thousands of goals over dds:// through a network that loses and reorders
fleet: $(VENV)/.tools  ## Kill and freeze workers and brokers of a fleet, ten times each
fuzz: $(VENV)/.fuzz  ## Send random bytes to a server for some minutes in all
attack: $(VENV)/.tools  ## Attack a server in every way, for 20 seconds each, beside an honest client
soak kills lossy fleet fuzz attack:
	$(BIN)/python -m tests.trials $@

mutants: .venv-mutants/.installed  ## Put small faults into the rules, and check that the tests find each
	.venv-mutants/bin/python -m tests.tools.mutants --keep

# Releases, and versions of others

ros: $(ROS_VENV)/.installed  ## Make .venv-ros, or with ROS=jazzy .venv-ros-jazzy: ROS 2 and interfaces
	@$(no_other_ros) tests/ros2/build_interfaces.sh $(ROS_VENV)

release: $(VENV)/.release $(VENV)/.docs  ## Prepare a release, VERSION=0.1.0, without the upload
	$(no_other_ros) tests/tools/release/make.sh $(VERSION)

lock:  ## Write the newest versions of the check's tools and libraries into tests/tools/lock.txt
	tests/tools/lock.sh

audit:  ## Look for known security problems in the libraries of the check, Python's and Node's
	tests/tools/lock.sh --audit

clean:  ## Remove all generated files
	rm -rf .venv .venv-* .cache build dist site .coverage* .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -prune -exec rm -r {} +

# The environments: each file says that a part is installed.

$(VENV)/.installed: pyproject.toml
	tests/tools/venv.sh $(VENV) -e .
	@touch $@

$(VENV)/.tools: $(VENV)/.installed
	tests/tools/venv.sh $(VENV) --group test --group browser --group check
	@touch $@

$(VENV)/.bench $(VENV)/.fuzz $(VENV)/.release $(VENV)/.docs: $(VENV)/.tools
	tests/tools/venv.sh $(VENV) --group $(@F:.%=%)
	@touch $@

# With dependencies that the tests must pass without; so have the environments of ROS, whose wheels
# start each Python of theirs twice.
.venv-%/.installed: pyproject.toml
	tests/tools/venv.sh .venv-$* -e . --group test --group $*
	@touch $@

build/javascript/.installed: tests/javascript/package.json tests/javascript/package-lock.json
	@tests/javascript/install.sh build/javascript
