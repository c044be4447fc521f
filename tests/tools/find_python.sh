#!/bin/sh
# Say where a Python of this version is (`find_python.sh 3.12`): on the path, or where pyenv or uv
# put it. It fails if there is none.
for python in "python$1" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/python \
    "$(uv python find --no-python-downloads "$1" 2>/dev/null)"; do
    # pyenv puts commands on the path that may only say that they are elsewhere.
    if "$python" -c "import sys; sys.exit('%d.%d' % sys.version_info[:2] != '$1')" 2>/dev/null; then
        echo "$python"
        exit 0
    fi
done
exit 1
