#!/bin/sh
# Make the environment of another Python, build/python3.12 (`other_python.sh build/python3.12 3.12`), or
# that of the lowest versions of the libraries (`other_python.sh build/lowest [VERSION]`), unless it is
# up to date.
set -e
folder=$1
if [ "$folder/.installed" -nt pyproject.toml ] && [ "$folder/.installed" -nt tests/tools/lowest.py ]; then
    exit
fi
rm -rf "$folder"
[ -z "$2" ] || PYTHON=$(tests/tools/find_python.sh "$2")
export PYTHON
constraint=
if [ "$(basename "$folder")" = lowest ]; then
    mkdir -p "$folder"
    constraint="--constraint $folder/lowest.txt"
    "${PYTHON:-python3}" -m tests.tools.lowest >"$folder/lowest.txt"
fi
# shellcheck disable=SC2086  # two words or none
tests/tools/venv.sh "$folder" -e '.[uvloop]' --group test $constraint
touch "$folder/.installed"
