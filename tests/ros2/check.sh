#!/bin/sh
# Run the tests with ROS 2 in an environment, and look at what they cover: `check.sh FOLDER`.
#
# `timeout` ends a process that hangs despite the timeouts of the tests. The tests wait for other
# processes half of the time, so two of them run at once. Some files of `dds://` and `zenoh://` run
# here, too: they use parts of both halves that rclpy's tests do not. One needs types that this
# environment has not.
set -e
rm -f .coverage-ros .coverage-ros.*
failures() { ls "${FIBACTION_SECOND_TRIES:-nowhere}"/*.json 2>/dev/null | wc -l; }
before=$(failures)
export COVERAGE_FILE=.coverage-ros
FIBACTION_ROS=required COVERAGE_PROCESS_START=tests/ros2/coverage.toml \
    timeout --foreground --kill-after=10 1200 \
    "$1/bin/python" -m pytest tests/ros2 -n 2 --dist loadfile \
    tests/transports/ros2/test_dds_transport.py tests/transports/ros2/test_learned_types.py \
    tests/transports/ros2/test_bridged_middlewares.py tests/transports/ros2/test_diagnosis.py \
    tests/transports/ros2/test_feedback_after_result.py tests/transports/ros2/test_middlewares.py \
    tests/transports/ros2/test_qos.py tests/transports/ros2/test_rogue_nodes.py \
    tests/transports/ros2/test_dds_types.py tests/transports/ros2/test_without_ros.py \
    tests/transports/ros2/test_zenoh_node.py \
    --deselect tests/transports/ros2/test_zenoh_node.py::test_a_server_that_does_not_describe_its_services_is_asked_for_the_feedback \
    -o faulthandler_timeout=75 -o faulthandler_exit_on_timeout=true
"$1/bin/python" -m coverage combine --quiet
# A test that has a second try at the end of `.ci/run` may leave lines uncovered.
if [ "$(failures)" = "$before" ]; then
    "$1/bin/python" -m coverage report --fail-under=100 \
        --include='*/fibaction_transports/ros2/*' \
        --omit='*/ros2/messaging/*,*/ros2/on_dds/*,*/ros2/on_zenoh/*,*/ros2/without_ros/*,*/ros2/dds_*.py,*/ros2/zenoh_*.py'
fi
