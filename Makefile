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
# The libraries of JavaScript that tests use.
JAVASCRIPT := build/javascript
# The other Pythons of pyproject.toml that are here.
PYTHONS = $(eval PYTHONS := $(shell PYTHON=$(PYTHON) tests/tools/find_python.sh --others))$(PYTHONS)

# The tests use the ROS of their environment, and not one that was sourced in the shell.
no_other_ros = env -u AMENT_PREFIX_PATH -u PYTHONPATH -u RMW_IMPLEMENTATION
pytest = $(no_other_ros) $(BIN)/python -m pytest -q
# Many tests wait for timeouts, so three of them share two cores.
export PYTEST_XDIST_AUTO_NUM_WORKERS ?= $(shell echo $$(( ($$(getconf _NPROCESSORS_ONLN) * 3 + 1) / 2 )))
at_once = -n auto --dist worksteal
# The tests start hundreds of processes, and each would compile all modules anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo check test elsewhere format lint types imports unit programs promtool chromium docs docs-serve bench regression simulate contract properties soak kills lossy fleet fuzz attack mutants openapi agents frontends test-ros test-wheel test-pythons test-lowest release lock audit ros clean

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
test: lint $(VENV)/.docs $(JAVASCRIPT)/.installed chromium promtool  ## Run all checks, but those with ROS 2 or other versions
	@MAKE="$(MAKE)" $(PYTHON) -m tests.tools.beside unit "imports types docs programs"

# One after the other, since tests with ROS 2 wait for real time. Of several other Pythons the first
# has the lowest versions, and no run of its own.
elsewhere:  ## Run the tests with ROS 2, with the wheel, the other Pythons and the lowest versions
	@$(MAKE) --no-print-directory test-ros ROS=kilted
	@$(MAKE) --no-print-directory test-ros ROS=jazzy
	@$(MAKE) --no-print-directory test-wheel
	@$(MAKE) --no-print-directory $(if $(word 2,$(PYTHONS)),test-lowest LOWEST=$(firstword $(PYTHONS)) \
	    $(patsubst %,test-python%,$(wordlist 2,9,$(PYTHONS))),test-pythons test-lowest)

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
PROGRAMS := $(addprefix tests/,browser fleet kills lossy soak support/test_walks.py test_examples.py test_stories.py)

unit: $(VENV)/.tools $(JAVASCRIPT)/.installed chromium promtool  ## Run the tests, and look at what they cover
	$(pytest) -p tests.tools.own_coverage $(at_once) --durations=25 $(addprefix --ignore=,$(PROGRAMS))

programs: $(VENV)/.tools $(JAVASCRIPT)/.installed chromium  ## Run the tests of whole programs: examples, walks, fleets, pages in a browser
	$(pytest) --durations=10 $(PROGRAMS)

promtool: $(VENV)/.tools  ## Get the checker of metrics that tests use
	@tests/tools/get.sh promtool

chromium:  ## Install the browser that tests use, where this user may
	@tests/tools/get.sh chromium

docs: $(VENV)/.docs  ## Build the documentation into site/
	$(BIN)/python docs/build.py

docs-serve: $(VENV)/.docs  ## Serve the documentation, rebuilt at each change
	$(BIN)/python -m tests.tools.promises
	$(BIN)/zensical serve

# The checks with other versions. What they leave out, and why, is in tests/tools/elsewhere.py.

test-ros: ros  ## Test the ROS 2 transport with ROS 2 Kilted, or with ROS=jazzy
	$(no_other_ros) tests/ros2/check.sh $(ROS_VENV)

test-wheel: $(VENV)/.release  ## Check the sdist and the wheel, and run the tests against the wheel
	$(no_other_ros) tests/packaging/check.sh $(PYTHONS)

test_elsewhere = FIBACTION_ELSEWHERE=1 FIBACTION_EXAMPLES=10 $(no_other_ros) $(1)/bin/python -m pytest -q \
    $(at_once) -o cache_dir=$(1)/.pytest_cache

test-pythons:  ## Run the tests with each other version of Python that is installed
	@$(foreach version,$(PYTHONS),$(MAKE) --no-print-directory test-python$(version) &&) true

test-python%: build/python%/.installed
	$(call test_elsewhere,build/python$*)

test-lowest: build/lowest/.installed  ## Run the tests with the lowest versions of libraries that are allowed
	$(call test_elsewhere,build/lowest)

openapi: $(VENV)/.tools .venv-openapi/.installed  ## Try the programs of others for OpenAPI at a server: clients, random requests
	FIBACTION_OPENAPI=required $(pytest) tests/transports/web/test_openapi_clients.py

agents: $(VENV)/.tools .venv-mcp-agents/.installed .venv-a2a-agents/.installed  ## Try the agents of others at a bridge: MCP's conformance suite, fastmcp, google-adk, strands
	FIBACTION_AGENTS=required $(pytest) tests/transports/mcp/test_official_clients.py tests/transports/a2a/test_agents_of_others.py

frontends: $(VENV)/.tools build/frontends/.installed  ## Try the hooks of examples/web in React, Vue and Svelte, and the client in Deno and Bun
	FIBACTION_FRONTENDS=required $(pytest) tests/javascript/test_frontends.py

# The trials of each night, and the measurements

bench: $(VENV)/.bench  ## Measure everything beside its peers, for docs/comparisons.md
	$(MAKE) --no-print-directory $(patsubst %,build/python%/.installed,$(PYTHONS))
	$(no_other_ros) tests/tools/benchmarks/all.sh $(SCALE)

regression: $(VENV)/.tools  ## Compare the speed with that of yesterday, or of BASE=COMMIT, and fail if it is 15 % less
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

release: $(VENV)/.release $(VENV)/.docs  ## Prepare a release, VERSION=0.1.0: files, packages and site, without the upload
	$(no_other_ros) tests/tools/release/make.sh $(VERSION)

lock:  ## Write the newest versions of the check's tools and libraries into tests/tools/lock.txt
	tests/tools/lock.sh

audit:  ## Look for known security problems in the libraries of the check, Python's and Node's
	tests/tools/lock.sh --audit

clean:  ## Remove all generated files
	rm -rf .venv .venv-* .cache build dist site .coverage* .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -prune -exec rm -r {} +

# The environments: each file says that a part is installed.

.SECONDARY:

$(VENV)/.installed: pyproject.toml
	tests/tools/venv.sh $(VENV) -e .
	@touch $@

$(VENV)/.tools: $(VENV)/.installed
	tests/tools/venv.sh $(VENV) --group test --group browser --group check
	@touch $@

$(VENV)/.bench $(VENV)/.fuzz $(VENV)/.release $(VENV)/.docs: $(VENV)/.tools
	tests/tools/venv.sh $(VENV) --group $(@F:.%=%)
	@touch $@

# With dependencies that the tests must pass without; so have the environments of ROS.
.venv-%/.installed: pyproject.toml
	tests/tools/venv.sh .venv-$* $(if $(filter openapi %-agents,$*),,-e . --group test) --group $*
	@touch $@

build/%/.installed: pyproject.toml tests/tools/lowest.py
	tests/tools/other_python.sh $(@D) $(if $(filter lowest,$*),$(LOWEST),$(*:python%=%))
	@touch $@

$(JAVASCRIPT)/.installed: tests/javascript/package.json tests/javascript/package-lock.json
	@tests/javascript/install.sh $(JAVASCRIPT)

build/frontends/.installed: tests/javascript/frontends/package.json tests/javascript/frontends/package-lock.json
	@FIBACTION_NODE=required tests/javascript/install.sh build/frontends tests/javascript/frontends

# ROS 2 has environments of its own, since its wheels start each Python of theirs twice: .venv-ros for
# Kilted, .venv-ros-jazzy for Jazzy. A package of interfaces comes before those that need it.
INTERFACES := examples/ros2/arduinobot_msgs tests/ros2/fibaction_test_msgs \
    $(addprefix tests/ros2/interfaces/,nav2_msgs nav_msgs trajectory_msgs control_msgs moveit_msgs) \
    $(addprefix tests/ros2/interfaces/,std_srvs tf2_msgs turtlesim)

ros: $(ROS_VENV)/.interfaces  ## Make .venv-ros, or with ROS=jazzy .venv-ros-jazzy: ROS 2 and interfaces

.venv-%/.interfaces: .venv-%/.installed examples/ros2/build_interfaces.py $(shell find $(INTERFACES) -type f)
	$(no_other_ros) tests/ros2/build_interfaces.sh $(@D) "$?" $(INTERFACES)
	@touch $@
