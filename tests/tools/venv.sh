#!/bin/sh
# Make a virtual environment where there is none, and install into it: `venv.sh FOLDER ARGUMENT...`,
# with the arguments of `pip install`. It takes uv if it is installed. PYTHON says which Python.
set -e
folder=$1
python=${PYTHON:-python3}
shift
if command -v uv >/dev/null; then
    [ -e "$folder/.made" ] || uv venv --quiet --allow-existing --python "$python" "$folder"
    uv pip install --quiet --python "$folder/bin/python" "$@"
else
    [ -e "$folder/.made" ] || {
        "$python" -m venv "$folder"
        "$folder/bin/python" -m pip install --quiet "pip>=25.1"
    }
    "$folder/bin/python" -m pip install --quiet "$@"
fi
touch "$folder/.made"
