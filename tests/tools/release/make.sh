#!/bin/sh
# Prepare a release, everything but the upload: `make.sh VERSION`. See docs/contributing.md.
set -e
[ -n "$1" ] || { echo "say which version: make release VERSION=0.1.0" && exit 2; }
.venv/bin/python -m tests.tools.release prepare "$1"
rm -rf dist build/release
mkdir -p build/release
.venv/bin/python -m build --quiet --outdir dist .
.venv/bin/python -m twine check --strict dist/*
# Each extra, none and all of them, each with the wheel in an environment of its own.
extras=$(sed -n '/^\[project.optional-dependencies\]/,/^$/s/^\([a-z0-9-]*\) = .*/\1/p' pyproject.toml)
for extra in none all $extras; do
    case $extra in
    none) chosen= ;;
    all) chosen="[$(echo $extras | tr ' ' ,)]" ;;
    *) chosen="[$extra]" ;;
    esac
    tests/tools/venv.sh "build/release/$extra" "fibaction$chosen @ file://$(echo "$PWD"/dist/*.whl)"
    (cd build/release && "$extra/bin/python" -P ../../tests/tools/release/extras.py "$extra" "$1")
    rm -r "build/release/$extra"
done
npm pack --silent --pack-destination build/release ./transports/fibaction_transports/web/javascript
.venv/bin/python docs/build.py
.venv/bin/python -m tests.tools.release check "$1"
