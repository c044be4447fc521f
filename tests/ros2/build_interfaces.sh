#!/bin/sh
# Build the interfaces of the tests in an environment of ROS 2: `build_interfaces.sh FOLDER`. If neither
# their files nor the wheels of ROS have changed since the last time, there is nothing to do.
set -e
folder=$1
here=tests/ros2/interfaces
# A package comes before those that need it.
packages="examples/ros2/arduinobot_msgs tests/ros2/fibaction_test_msgs
    $here/nav2_msgs $here/nav_msgs $here/trajectory_msgs $here/control_msgs $here/moveit_msgs
    $here/std_srvs $here/tf2_msgs $here/turtlesim"
built=$folder/.interfaces
wheels=$(ls -d "$folder"/lib/python*/site-packages/ros_*.dist-info)
# shellcheck disable=SC2086  # a word for each package
if [ ! -e "$built" ] || [ "$wheels" != "$(cat "$folder/.wheels" 2>/dev/null)" ] ||
    [ -n "$(find examples/ros2/build_interfaces.py $packages -type f -newer "$built")" ]; then
    tests/tools/get.sh compiler
    echo "building the interfaces of the tests: some minutes"
    "$folder/bin/python" examples/ros2/build_interfaces.py $packages
    echo "$wheels" >"$folder/.wheels"
    touch "$built"
fi
