#!/bin/sh
# Write the newest versions of the check's tools and libraries into tests/tools/lock.txt; with --audit,
# look for known security problems in those that it has, Python's and Node's.
set -e
if [ "$1" = --audit ]; then
    tests/tools/venv.sh build/audit --group audit
    build/audit/bin/python -m pip_audit --no-deps --disable-pip --requirement tests/tools/lock.txt
    cd tests/javascript
    exec npm audit
fi
rm -rf build/lock
tests/tools/venv.sh build/lock -e . --group test --group browser --group check --group docs --group release
build/lock/bin/python -m tests.tools.lock >build/lock/lock.txt
cp build/lock/lock.txt tests/tools/lock.txt
