#!/bin/sh
# Build interfaces in an environment of ROS 2: `build_interfaces.sh FOLDER CHANGED PACKAGE...`. If no
# file but the environment's own has changed, and the wheels of ROS are the same, they are built.
set -e
folder=$1
changed=$2
shift 2
wheels=$(ls -d "$folder"/lib/python*/site-packages/ros_*.dist-info)
if [ "$changed" != "$folder/.installed" ] || [ "$wheels" != "$(cat "$folder/.wheels" 2>/dev/null)" ]; then
    tests/tools/get.sh compiler
    echo "building the interfaces $*: some minutes"
    "$folder/bin/python" examples/ros2/build_interfaces.py "$@"
    echo "$wheels" >"$folder/.wheels"
fi
