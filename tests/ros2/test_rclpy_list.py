"""rclpy's own tests of its actions, each with the test here that covers it.

Their names are those of `rclpy/test/test_action_server.py`, `test_action_client.py` and
`test_action_graph.py`, without `test_`. Our server is tested with rclpy's client, and our client
with rclpy's server.
"""

from __future__ import annotations

from types import ModuleType

import pytest

from tests.ros2 import test_against_rclpy as server
from tests.ros2 import test_rclpy_servers as client

NOT_OURS = {
    "constructor_defaults, constructor_no_defaults": "methods of rclpy's own classes",
    "get_num_entities": "counts rclpy's own waitables; fibaction has one of its own",
    "configure_introspection_content": "fibaction offers no service introspection",
}
SERVER = {
    **NOT_OURS,
    "single_goal_accept": "test_a_goal_is_accepted_with_a_stamp",
    "single_goal_reject": "test_a_rejected_goal_is_unknown_afterwards",
    "goal_callback_invalid_return": (
        "test_a_callback_that_raises_rejects_the_goal_and_the_server_goes_on"
    ),
    "multi_goal_accept": "test_several_goals_at_once_all_succeed",
    "duplicate_goal": (
        "test_an_id_in_use_is_rejected_while_the_goal_runs_and_while_it_is_remembered"
    ),
    "cancel_goal_accept": "test_a_cancel_is_accepted_and_the_goal_ends_as_canceled",
    "cancel_goal_reject": "test_a_rejected_cancel_says_so_and_the_goal_goes_on",
    "execute_succeed, feedback": "test_feedback_arrives_in_order_and_the_result_after_it",
    "execute_abort": "test_an_abort_comes_with_the_part_that_is_done",
    "execute_no_terminal_state, execute_raises_exception, different_feedback_type_raises": (
        "test_an_executor_that_goes_wrong_is_aborted_with_an_empty_result"
    ),
    "expire_goals_none": "test_a_result_can_be_asked_for_late_and_again",
    "expire_goals_one, expire_goals_multi": ("test_a_result_expires_and_then_the_id_is_free_again"),
    "without_execute_cb": "a goal of fibaction is executed by its executor only",
    "cancel_defered_goal": "our server defers nothing; our client is tested with such a server",
    "action_introspection_default_status": "test_services_publish_no_events_of_introspection",
}
CLIENT = {
    **NOT_OURS,
    "wait_for_server_nowait, wait_for_server_timeout, send_goal_async_no_server": (
        "test_a_server_that_is_not_there_is_not_found"
    ),
    "wait_for_server_exists": "test_a_server_that_is_there_is_found_at_once",
    "send_goal_async, send_goal_async_with_feedback_after_goal, get_result_async": (
        "test_feedback_arrives_in_order_and_the_result_after_it"
    ),
    "send_goal_async_with_feedback_before_goal, send_goal_async_with_feedback_for_another_goal,"
    " send_goal_async_with_feedback_for_not_a_goal, send_goal_multiple": (
        "test_several_goals_run_side_by_side_and_each_gets_its_own"
    ),
    "send_goal_async_with_feedback_after_goal_result_requested": (
        "fibaction requests the result by itself, and delivers feedback until the goal ends"
    ),
    "send_cancel_async": "test_an_accepted_cancel_ends_the_goal_with_the_part_that_is_done",
    "different_type_raises": "test_a_goal_of_another_type_is_rejected_before_it_is_sent",
    "action_introspection_default_status": "the stock server has rclpy's own services",
}
GRAPH = {
    "get_action_client_names_and_types_by_node, get_action_server_names_and_types_by_node,"
    " get_action_names_and_types": "test_the_graph_shows_the_action_its_server_and_its_client",
}


@pytest.mark.parametrize(
    ("listed", "module", "count"), [(SERVER, server, 23), (CLIENT, client, 19), (GRAPH, server, 3)]
)
def test_every_test_of_rclpy_is_covered_or_has_a_reason(
    listed: dict[str, str], module: ModuleType, count: int
) -> None:
    assert sum(len(names.split(", ")) for names in listed) == count
    for names, where in listed.items():
        assert " " in where or hasattr(module, where), names
