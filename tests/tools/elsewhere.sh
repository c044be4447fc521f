#!/bin/sh
# Run the tests again, with other versions: `elsewhere.sh pythons`, with each other Python that is here;
# `elsewhere.sh lowest`, with the lowest versions of the libraries that are allowed; or both,
# `elsewhere.sh lowest pythons`. What is left out then, and why, is in elsewhere.py.
set -e

# Run them in build/$1, with a Python of version $2.
run() {
    tests/tools/other_python.sh "build/$1" "$2"
    FIBACTION_ELSEWHERE=1 FIBACTION_EXAMPLES=10 "build/$1/bin/python" -m pytest -q \
        -n auto --dist worksteal -o "cache_dir=build/$1/.pytest_cache"
}

# shellcheck disable=SC2046  # one word for each version
case $* in
pythons) set -- $(tests/tools/find_python.sh --others) ;;
lowest)
    run lowest
    exit
    ;;
"lowest pythons")
    set -- $(tests/tools/find_python.sh --others)
    # Of several Pythons the first has the lowest versions, and no run of its own.
    if [ $# -ge 2 ]; then
        run lowest "$1"
        shift
    else
        run lowest
    fi
    ;;
*) exit 2 ;;
esac
for version in "$@"; do run "python$version" "$version"; done
