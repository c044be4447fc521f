#!/bin/sh
# Install the libraries of JavaScript that tests use into a folder: `install.sh FOLDER`, or those that
# another folder lists: `install.sh FOLDER LISTS`. Without Node these tests are left out, unless
# FIBACTION_NODE is `required`.
lists=${2:-tests/javascript}
tests/tools/get.sh node
mkdir -p "$1"
cp "$lists/package.json" "$lists/package-lock.json" "$1"
if command -v npm >/dev/null && (cd "$1" && npm ci --silent --ignore-scripts --no-audit --no-fund)
then
    touch "$1/.installed"
else
    rm -rf "$1/node_modules"
    echo "tests with Node are left out: their libraries cannot be installed"
    [ "$FIBACTION_NODE" != required ]
fi
