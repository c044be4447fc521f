#!/bin/sh
# Measure everything beside its peers, for docs/comparisons.md: `all.sh SCALE`, of which less than 1 is
# faster, and less exact. The other versions of Python are those that have an environment in build/.
set -e
for version in $(tests/tools/find_python.sh --others); do
    tests/tools/other_python.sh "build/python$version" "$version"
done
tests/tools/get.sh nats
.venv/bin/python -m tests.tools.benchmarks all --scale "$1"
.venv/bin/python -m tests.tools.benchmarks.functions --write
.venv/bin/python -m tests.tools.benchmarks.durable
.venv/bin/python -m tests.tools.benchmarks.fleet feedback
.venv/bin/python -m tests.tools.benchmarks.pythons --write
