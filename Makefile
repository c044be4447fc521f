# `make demo` shows it, `make test` checks it. Both make a virtual environment, with uv if it is
# installed, and skip the steps that are up to date.

PYTHON ?= python3
# The amount of work of `make bench`: less is faster, and less exact.
SCALE ?= 1
VENV := .venv
BIN := $(VENV)/bin

# Many tests wait for timeouts, so three of them share two cores.
export PYTEST_XDIST_AUTO_NUM_WORKERS ?= $(shell echo $$(( ($$(getconf _NPROCESSORS_ONLN) * 3 + 1) / 2 )))

# mutmut has an environment of its own, since the tests must pass without its dependencies.
MUTANTS_VENV := .venv-mutants

# So have the programs of others for OpenAPI, one of which is a plugin of pytest.
OPENAPI_VENV := .venv-openapi

# The libraries of JavaScript that tests use. Without Node these tests are left out, unless
# FIBACTION_NODE is `required`.
JAVASCRIPT := build/javascript

# ROS 2 has a virtual environment of its own: its wheels start each Python of theirs twice. The release
# is Kilted, in .venv-ros with the dependency group `ros`, or with ROS=jazzy Jazzy, in .venv-ros-jazzy
# with the group `ros-jazzy`.
ROS ?= kilted
ROS_GROUP := $(if $(filter kilted,$(ROS)),ros,ros-$(ROS))
ROS_VENV := .venv-$(ROS_GROUP)
ROS_BIN := $(ROS_VENV)/bin
# A package comes before those that need it.
INTERFACES := examples/ros2/arduinobot_msgs tests/ros2/fibaction_test_msgs \
    $(addprefix tests/ros2/interfaces/,nav2_msgs nav_msgs trajectory_msgs control_msgs moveit_msgs)
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
.PHONY: help demo check test elsewhere format lint types imports unit programs promtool chromium docs docs-serve bench regression simulate contract properties soak kills lossy fleet fuzz attack mutants openapi test-ros test-wheel test-pythons test-lowest release lock audit ros clean

help:  ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1\t\2/p' Makefile | expand -t 20

demo: $(VENV)/.installed  ## Run a Fibonacci goal: feedback, a cancel half-way, a result
	@$(BIN)/python examples/fibonacci_demo.py

check: lint imports $(VENV)/.tools  ## Run the quick checks, in less than a minute
	$(BIN)/mypy fibaction transports
	$(BIN)/python -m pytest -q -n auto --dist worksteal $(QUICK)

# The rules without I/O, both ends of an action, and what the project says of itself.
QUICK := tests/server tests/wire tests/interfaces tests/words tests/types tests/client tests/test_api.py \
    tests/test_contributing.py tests/test_init.py tests/test_project.py tests/test_structure.py \
    tests/test_style.py tests/test_answers.py

# The unit tests wait half of the time, so the other checks run beside them: first those that need a
# processor, then the tests of programs, which wait for most of the time.
test: lint $(VENV)/.docs $(JAVASCRIPT)/.installed chromium promtool  ## Run all checks, but those with ROS 2 or other versions
	@$(stages) "unit" "imports, types, docs, programs"

# One after the other: tests with ROS 2 wait for real time, and fail beside others on a busy machine.
# If there are two other Pythons or more, the lowest versions are tested with the first of them, which
# has no run of its own then: each Python is tested, and the lowest and the newest versions are.
elsewhere:  ## Run the tests with ROS 2, with the wheel, the other Pythons and the lowest versions
	@$(stages) "test-ros ROS=kilted, test-ros ROS=jazzy, test-wheel, $(if $(word 2,$(OTHERS_HERE)),$(two_in_one),test-pythons, test-lowest)"
OTHERS_HERE = $(foreach version,$(PYTHONS),$(if $(shell tests/tools/find_python.sh $(version)),$(version)))
with_lowest = $(firstword $(OTHERS_HERE))
two_in_one = test-pythons PYTHONS='$(filter-out $(with_lowest),$(PYTHONS))'$(comma) test-lowest PYTHON=$(shell tests/tools/find_python.sh $(with_lowest))

stages = MAKE="$(MAKE)" $(PYTHON) -m tests.tools.stages

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

imports: $(VENV)/.tools  ## Check that imports point one way
	$(BIN)/lint-imports

unit: $(VENV)/.tools $(JAVASCRIPT)/.installed chromium promtool  ## Run the tests, and check that they cover each unit
	$(no_other_ros) $(BIN)/python -m pytest -p tests.tools.own_coverage -n auto --dist worksteal --durations=25 \
	    $(addprefix --ignore=,$(PROGRAMS))

# One after the other: they start processes, and wait for what these do in real time. None of them
# covers a unit.
PROGRAMS := tests/browser tests/fleet tests/kills tests/lossy tests/soak tests/support/test_walks.py \
    tests/test_examples.py tests/test_stories.py

programs: $(VENV)/.tools $(JAVASCRIPT)/.installed chromium  ## Run the tests of whole programs: examples, walks, fleets, pages in a browser
	$(no_other_ros) $(BIN)/python -m pytest -q --durations=10 $(PROGRAMS)

# The checker of metrics. As a package it would start a service, so it is unpacked only.
promtool: $(VENV)/.tools  ## Get the checker of metrics that tests use
	@which promtool >/dev/null || [ -d $(VENV)/prometheus ] || ! which apt-get >/dev/null || \
	    { cd $(VENV) && apt-get download -qq prometheus 2>/dev/null && \
	    dpkg -x prometheus_*.deb prometheus && rm prometheus_*.deb; } || true

# The browser of tests/browser, as `ros` has its compiler: where this user may install packages. The
# tests take the one with windows where it is the only one.
chromium:  ## Install the browser that tests use, where this user may
	@[ -x /usr/bin/chromium-headless-shell ] || [ "$$(id -u)" != 0 ] || ! which apt-get >/dev/null || \
	    { apt-get update -qq && apt-get install -yqq --no-install-recommends chromium-headless-shell fonts-dejavu-core >/dev/null; } || true
	@[ -x /usr/bin/chromium-headless-shell ] || [ -x /usr/bin/chromium ] || \
	    echo "the tests in a browser are left out: /usr/bin/chromium-headless-shell is missing"

docs: $(VENV)/.docs  ## Build the documentation into site/
	$(BIN)/python docs/build.py

docs-serve: $(VENV)/.docs  ## Serve the documentation, rebuilt at each change
	$(BIN)/python -m tests.tools.promises
	$(BIN)/zensical serve

# Servers of NATS and of Redis are unpacked rather than installed: as packages, they would start
# services.
bench: $(VENV)/.bench  ## Measure everything beside its peers, for docs/comparisons.md
	@cd $(VENV) && which nats-server >/dev/null || [ -d nats ] || ! which apt-get >/dev/null || \
	    { apt-get download -qq nats-server 2>/dev/null && dpkg -x nats-server_*.deb nats; } || true
	@cd $(VENV) && which redis-server >/dev/null || [ -d redis ] || ! which apt-get >/dev/null || \
	    { apt-get download -qq redis-server redis-tools libjemalloc2 liblzf1 2>/dev/null && \
	    for package in redis-*.deb libjemalloc2_*.deb liblzf1_*.deb; do dpkg -x $$package redis; done; } || true
	$(no_other_ros) $(BIN)/python -m tests.tools.benchmarks all --scale $(SCALE)
	$(BIN)/python -m tests.tools.benchmarks.durable
	$(BIN)/python -m tests.tools.benchmarks.fleet
	@for version in $(PYTHONS); do \
	    if python=$$(tests/tools/find_python.sh $$version); \
	    then $(MAKE) --no-print-directory build/python$$version/.installed PYTHON=$$python || exit; fi; \
	done
	$(BIN)/python -m tests.tools.benchmarks.pythons --write

# Against the newest commit that is a day old, or BASE=COMMIT.
regression: $(VENV)/.tools  ## Compare the speed with that of yesterday, and fail if it is 15 % less
	$(BIN)/python -m tests.tools.benchmarks.regression --base "$(BASE)"

MINUTES ?= 10
simulate: $(VENV)/.tools  ## Run random scenarios in virtual time for ten minutes, or MINUTES=60
	$(BIN)/python -m tests.simulation --seconds $$(( $(MINUTES) * 60 ))

contract: $(VENV)/.tools  ## Run each test of the contract over each transport, on asyncio and on trio
	FIBACTION_CONTRACT=whole $(no_other_ros) $(BIN)/python -m pytest -q -n auto --dist worksteal tests/contract

properties: $(VENV)/.tools  ## Run the property tests with a thousand examples each
	FIBACTION_EXAMPLES=1000 $(no_other_ros) $(BIN)/python -m pytest -q -n auto --dist worksteal -m hypothesis --timeout 1800

soak: $(VENV)/.tools  ## Run fifty connections for ten minutes, alone and beside load: nothing grows
	$(BIN)/python -m tests.soak --keep
	$(BIN)/python -m tests.soak --load 4 --keep

kills: $(VENV)/.tools  ## Kill a server that keeps its goals, for two minutes twice, and start it again
	FIBACTION_KILLS=100 $(BIN)/python -m pytest -q tests/stores/test_sqlite_store.py -k after_kills --timeout 600
	$(BIN)/python -m tests.kills --seconds 120 --clients 20
	$(BIN)/python -m tests.kills --seconds 120 --clients 20 --recovery rerun

lossy: $(VENV)/.tools  ## Send thousands of goals over dds:// through a network that loses and reorders
	$(BIN)/python -m tests.lossy

fleet: $(VENV)/.tools  ## Kill and freeze workers and brokers of a fleet, ten times each
	$(BIN)/python -m tests.fleet all --times 10

# It begins with the inputs in tests/fuzz/corpus; `-merge=1` adds to them what was found.
fuzz: $(VENV)/.fuzz  ## Send random bytes to a server for some minutes in all
	$(BIN)/python -m tests.fuzz.wire -max_total_time=30
	$(BIN)/python -m tests.fuzz.websocket -max_total_time=30
	$(BIN)/python -m tests.fuzz.web -max_total_time=30
	$(BIN)/python -m tests.fuzz.rosbridge -max_total_time=30
	$(BIN)/python -m tests.fuzz.rtps -max_total_time=30

attack: $(VENV)/.tools  ## Attack a server in every way, for 20 seconds each, beside an honest client
	$(BIN)/python -m tests.hostile
	$(BIN)/python -m tests.hostile.rtps

mutants: $(MUTANTS_VENV)/.installed  ## Put small faults into the rules, and check that the tests find each
	$(MUTANTS_VENV)/bin/python -m tests.tools.mutants --keep

openapi: $(VENV)/.tools $(OPENAPI_VENV)/.installed  ## Try the programs of others for OpenAPI at a server: clients, random requests
	FIBACTION_OPENAPI=required $(BIN)/python -m pytest -q tests/transports/web/test_openapi_clients.py

# The wheel is made from the sdist, as packagers do; and from the checkout, to compare. The code is
# that of `make test`, so what runs against it is what a wheel can lack: modules, entry points, files.
# Of the contract two parts do, since each of them goes over each transport.
test-wheel: $(VENV)/.release  ## Check the sdist and the wheel, and run the tests against the wheel
	rm -rf dist build/checkout build/consumer* build/wheel
	$(BIN)/python -m build --quiet --outdir dist .
	$(BIN)/python -m build --quiet --outdir build/checkout --wheel .
	$(BIN)/python -m twine check --strict dist/*
	$(call new_venv,build/consumer)
	$(call install,build/consumer) dist/*.whl
	@for version in $(PYTHONS); do \
	    if python=$$(tests/tools/find_python.sh $$version); \
	    then $(MAKE) --no-print-directory build/consumer$$version PYTHON=$$python || exit; fi; \
	done
	FIBACTION_BUILT=1 $(BIN)/python -m pytest tests/packaging
	$(call new_venv,build/wheel)
	$(call install,build/wheel) dist/*.whl --group test
	cd build && $(no_other_ros) wheel/bin/python -m pytest -q -n auto --dist worksteal -c ../pyproject.toml --rootdir .. -o pythonpath= \
	    -o cache_dir=build/.pytest_cache -k "$(ways_elsewhere)" $(addprefix ../,$(OF_A_WHEEL))
OF_A_WHEEL := tests/contract/test_accepting.py tests/contract/test_scheduling.py tests/test_examples.py tests/test_init.py tests/test_main.py tests/test_stories.py tests/transports/web/test_assets.py

# Everything but the upload, in a checkout without other changes. What a person does then is in
# docs/contributing.md.
release: $(VENV)/.release $(VENV)/.docs  ## Prepare a release, VERSION=0.1.0: files, packages and site, without the upload
	@[ -n "$(VERSION)" ] || { echo "say which version: make release VERSION=0.1.0"; exit 2; }
	$(BIN)/python -m tests.tools.release prepare $(VERSION)
	rm -rf dist build/release
	mkdir -p build/release
	$(BIN)/python -m build --quiet --outdir dist .
	$(BIN)/python -m twine check --strict dist/*
	@for extra in $(EXTRAS); do \
	    $(MAKE) --no-print-directory build/release/$$extra VERSION=$(VERSION) || exit; \
	done
	npm pack --silent --pack-destination build/release ./$(JAVASCRIPT_PACKAGE)
	$(BIN)/python docs/build.py
	$(BIN)/python -m tests.tools.release check $(VERSION)

# The newest versions, in an environment of their own. The workflows install with them.
lock:  ## Write the versions of the check's tools and libraries into tests/tools/lock.txt
	rm -rf build/lock
	mkdir -p build
	$(call new_venv,build/lock)
	$(call install,build/lock) -e . $(addprefix --group ,test browser check docs release)
	build/lock/bin/python -m tests.tools.lock > build/lock/lock.txt
	cp build/lock/lock.txt tests/tools/lock.txt

audit:  ## Look for known security problems in the libraries of the check, Python's and Node's
	$(call new_venv,build/audit)
	$(call install,build/audit) --group audit
	build/audit/bin/python -m pip_audit --no-deps --disable-pip --requirement tests/tools/lock.txt
	cd tests/javascript && npm audit

JAVASCRIPT_PACKAGE := transports/fibaction_transports/web/javascript
EXTRAS = none all $(shell sed -n '/^\[project.optional-dependencies\]/,/^$$/s/^\([a-z0-9-]*\) = .*/\1/p' pyproject.toml)
extra_of = $(filter-out [none],[$(if $(filter all,$(1)),$(subst $(space),$(comma),$(filter-out none all,$(EXTRAS))),$(1))])
comma := ,
space := $() $()

# An environment with the wheel and one extra, and what the extra is for, tried there.
build/release/%:
	@$(call new_venv,$@)
	@$(call install,$@) "$(strip fibaction$(call extra_of,$*) @ file://$(abspath $(wildcard dist/*.whl)))"
	@cd build/release && $(no_other_ros) $*/bin/python -P $(CURDIR)/tests/tools/release/extras.py $* $(VERSION)
	@rm -r $@

build/consumer%:
	$(call new_venv,$@)
	$(call install,$@) dist/*.whl

# The versions in pyproject.toml that `make test` does not use.
PYTHONS = $(filter-out $(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])'),3.11 3.12 3.13)
# What differs between versions of Python is its event loop, its sockets, TLS, SQLite, typing and
# tracebacks; between those of libraries, what they are called with. So each part that uses one of
# these is tested with it: the server, the wire, the stores, each transport, the tools, and the command
# line. Left to `make test` is what would be the same again:
# - the contract but in one process, over TCP, HTTP and NATS, and trio but over TCP: the rest of its
#   ways combines parts that have tests of their own, TLS, WebSockets and stores among them;
# - rules without I/O, virtual time, and most examples of property tests; of RTPS and CDR, what uses
#   sockets and the messages of actions stay;
# - trials, attacks and floods of servers, tests marked `load`, browsers and Node, which load what is
#   tested already;
# - programs of others, of Cyclone DDS and rosbridge: they get the same bytes;
# - verbs of the command line that put together what is tested by itself, a server, a client and
#   lines or a page: of those that start processes, the ones about signals, files, terminals and the
#   libraries of an extra stay;
# - a system that is not Unix, which Linux plays by taking modules away;
# - pages, pictures, examples, the files of the console, the tests' own support and the project itself.
test_elsewhere = FIBACTION_EXAMPLES=10 $(no_other_ros) $(1)/bin/python -m pytest -q -n auto --dist worksteal \
    -o cache_dir=$(1)/.pytest_cache -m "not load" -k "$(ways_elsewhere) and not (contract and (asyncio-tls or asyncio-ws or store]))" \
    tests $(addprefix --ignore=tests/,$(NOT_ELSEWHERE))
ways_elsewhere := (not trio or trio-tcp) and not asyncio-gateway and not asyncio-unix and not asyncio-wss and not asyncio-asgi and not [virtual and not -virtual
RTPS_WITHOUT_SOCKETS := $(patsubst tests/%,%,$(filter-out %/test_network.py,$(wildcard tests/transports/rtps/test_*.py)))
NOT_ELSEWHERE := browser fleet fleet_simulation fuzz hostile javascript kills packaging simulation soak support tools \
    cli/test_bridge.py cli/test_console.py cli/test_fleet_commands.py cli/test_hostile.py cli/test_pictures.py \
    cli/test_recording_verbs.py interfaces/test_parser.py \
    server/test_registry.py server/test_schedule_load.py server/test_scheduler.py server/test_fair_queue.py \
    schema/test_check.py schema/test_keywords.py schema/test_json_schema.py schema/test_steps.py \
    transports/cdr/test_codec.py transports/cdr/test_hostile.py transports/cdr/test_type_hashes.py \
    transports/cyclone transports/mcp/test_page.py $(RTPS_WITHOUT_SOCKETS) transports/test_forged_lines.py \
    transports/web/rosbridge/test_libraries.py transports/web/test_assets.py transports/web/test_openapi.py \
    words/test_goals.py words/test_statuses.py \
    test_answers.py test_contributing.py test_cookbook.py test_docs.py test_examples.py test_guarantees.py \
    test_notebook_page.py test_project.py test_stories.py test_structure.py test_style.py test_way_of_a_goal.py \
    test_without_unix.py

test-pythons:  ## Run the tests with each other version of Python that is installed
	@for version in $(PYTHONS); do \
	    if ! python=$$(tests/tools/find_python.sh $$version); \
	    then echo "Python $$version is left out: it is not here"; \
	    else $(MAKE) --no-print-directory test-python$$version PYTHON=$$python || exit; fi; \
	done

test-python%: build/python%/.installed
	$(call test_elsewhere,build/python$*)

test-lowest: build/lowest/.installed  ## Run the tests with the lowest versions of libraries that are allowed
	$(call test_elsewhere,build/lowest)

# What needs no ROS, `ros2/on_dds`, is covered by tests of its own in `make unit`.
# `timeout` ends a process that hangs despite the timeouts of the tests. The tests wait for other
# processes half of the time, so two of them run at once.
# A test that fails, and has a second try at the end of `.ci/run`, may leave lines uncovered.
# Some tests of `dds://` run there, too: they use parts of both halves that rclpy's tests do not.
OVER_BOTH := tests/transports/ros2/test_dds_transport.py tests/transports/ros2/test_learned_types.py

test-ros: $(ROS_VENV)/.interfaces  ## Test the ROS 2 transport with ROS 2 Kilted, or with ROS=jazzy
	rm -f .coverage-ros .coverage-ros.*
	FIBACTION_ROS=required COVERAGE_PROCESS_START=tests/ros2/coverage.toml COVERAGE_FILE=.coverage-ros \
	    $(no_other_ros) timeout --foreground --kill-after=10 1200 \
	    $(ROS_BIN)/python -m pytest tests/ros2 $(OVER_BOTH) -n 2 --dist loadfile \
	    -o faulthandler_timeout=75 -o faulthandler_exit_on_timeout=true
	$(ROS_BIN)/python -m coverage combine --quiet --data-file=.coverage-ros
	@ls $${FIBACTION_SECOND_TRIES:-nowhere}/*.json >/dev/null 2>&1 || \
	    $(ROS_BIN)/python -m coverage report --data-file=.coverage-ros \
	    --include='*/fibaction_transports/ros2/*' --omit='*/ros2/on_dds/*,*/ros2/dds_transport.py' --fail-under=100

ros: $(ROS_VENV)/.interfaces  ## Make .venv-ros, or with ROS=jazzy .venv-ros-jazzy: ROS 2 and interfaces

clean:  ## Remove all generated files
	rm -rf $(VENV) $(MUTANTS_VENV) $(OPENAPI_VENV) .venv-ros .venv-ros-* .cache build dist site .coverage* .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -prune -exec rm -r {} +

$(VENV)/.made:
	$(call new_venv,$(VENV))
	@touch $@

$(VENV)/.installed: $(VENV)/.made pyproject.toml
	$(call install,$(VENV)) -e .
	@touch $@

$(VENV)/.tools: $(VENV)/.installed
	$(call install,$(VENV)) --group test --group browser --group check
	@touch $@

$(JAVASCRIPT)/.installed: tests/javascript/package.json tests/javascript/package-lock.json
	@{ which node && which npm; } >/dev/null || [ "$$(id -u)" != 0 ] || ! which apt-get >/dev/null || \
	    { apt-get update -qq && apt-get install -yqq --no-install-recommends nodejs npm; } || true
	@mkdir -p $(@D)
	@cp $^ $(@D)
	@if which npm >/dev/null && cd $(@D) && npm ci --silent --ignore-scripts --no-audit --no-fund; \
	    then touch $(CURDIR)/$@; else rm -rf $(CURDIR)/$(@D)/node_modules; \
	    echo "tests with Node are left out: their libraries cannot be installed"; \
	    [ "$$FIBACTION_NODE" != required ]; fi

$(VENV)/.docs: $(VENV)/.tools
	$(call install,$(VENV)) --group docs
	@touch $@

$(VENV)/.release: $(VENV)/.tools
	$(call install,$(VENV)) --group release
	@touch $@

$(VENV)/.fuzz: $(VENV)/.tools
	$(call install,$(VENV)) --group fuzz
	@touch $@

$(OPENAPI_VENV)/.installed: pyproject.toml
	$(call new_venv,$(OPENAPI_VENV))
	$(call install,$(OPENAPI_VENV)) --group openapi
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

build/lowest/.installed: pyproject.toml tests/tools/lowest.py
	rm -rf $(@D)
	mkdir -p build
	$(call new_venv,$(@D))
	$(PYTHON) -m tests.tools.lowest > $(@D)/lowest.txt
	$(call install,$(@D)) -e '.[uvloop]' --group test --constraint $(@D)/lowest.txt
	@touch $@

$(ROS_VENV)/.made:
	$(call new_venv,$(ROS_VENV))
	@touch $@

$(ROS_VENV)/.installed: $(ROS_VENV)/.made pyproject.toml
	@echo "installing ROS 2 from wheels into $(ROS_VENV): a minute or two"
	$(call install,$(ROS_VENV)) -e . --group test --group $(ROS_GROUP)
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
	@echo "building the interfaces $(notdir $(INTERFACES)): some minutes"
	$(no_other_ros) $(ROS_BIN)/python examples/ros2/build_interfaces.py $(INTERFACES)
	@touch $@
