#!/bin/sh
# Check the sdist and the wheel, install it with each other version of Python that is here, and run
# tests against it.
#
# The wheel is made from the sdist, as packagers do; and from the checkout, to compare. The code is
# that of `make test`, so what runs against it is what a wheel can lack: modules, entry points, files.
set -e
rm -rf dist build/checkout build/consumer* build/wheel
.venv/bin/python -m build --quiet --outdir dist .
.venv/bin/python -m build --quiet --outdir build/checkout --wheel .
.venv/bin/python -m twine check --strict dist/*
tests/tools/venv.sh build/consumer dist/*.whl
for version in $(tests/tools/find_python.sh --others); do
    PYTHON=$(tests/tools/find_python.sh "$version") tests/tools/venv.sh "build/consumer$version" dist/*.whl
done
FIBACTION_BUILT=1 .venv/bin/python -m pytest tests/packaging
tests/tools/venv.sh build/wheel dist/*.whl --group test
cd build
FIBACTION_ELSEWHERE=1 wheel/bin/python -m pytest -q -n auto --dist worksteal \
    -c ../pyproject.toml --rootdir .. -o pythonpath= -o cache_dir=build/.pytest_cache \
    ../tests/contract/test_transports.py \
    ../tests/test_examples.py ../tests/test_init.py ../tests/test_main.py ../tests/test_stories.py \
    ../tests/transports/web/test_assets.py
