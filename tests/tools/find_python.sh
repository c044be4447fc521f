#!/bin/sh
# Say where a Python of this version is (`find_python.sh 3.12`): on the path, or where pyenv or uv
# put it. It fails if there is none. With --others, say which of the versions in pyproject.toml are
# here, but the one of PYTHON.
if [ "$1" = --others ]; then
    own=$("${PYTHON:-python3}" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    for version in 3.11 3.12 3.13; do
        if [ $version != "$own" ]; then
            "$0" $version >/dev/null && echo $version || echo "Python $version is not here" >&2
        fi
    done
    exit
fi
for python in "python$1" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/python \
    "$(uv python find --no-python-downloads "$1" 2>/dev/null)"; do
    # pyenv puts commands on the path that may only say that they are elsewhere.
    if "$python" -c "import sys; sys.exit('%d.%d' % sys.version_info[:2] != '$1')" 2>/dev/null; then
        echo "$python"
        exit 0
    fi
done
exit 1
