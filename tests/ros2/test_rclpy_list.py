"""What rclpy tests of its own actions, and where that is tested here.

The names are those of `rclpy/test/test_action_server.py`, `test_action_client.py` and
`test_action_graph.py`. Both halves of ours are looked at against rclpy's other half.
"""

from __future__ import annotations

from types import ModuleType

import pytest

from tests.ros2 import test_against_rclpy as server
from tests.ros2 import test_rclpy_servers as client

RCLPY_API = "about the methods of rclpy's own classes, which fibaction has not"
OWN_ENTITIES = "counts rclpy's own waitables; fibaction has one of its own"
INTROSPECTION = "fibaction offers no service introspection; that it is off is tested"

SERVER: dict[str, str] = {
    "test_constructor_defaults": RCLPY_API,
    "test_constructor_no_defaults": RCLPY_API,
    "test_get_num_entities": OWN_ENTITIES,
    "test_single_goal_accept": "test_a_goal_is_accepted_with_a_stamp",
    "test_single_goal_reject": "test_a_rejected_goal_is_known_to_nobody",
    "test_goal_callback_invalid_return": (
        "test_a_callback_that_raises_rejects_the_goal_and_the_server_goes_on"
    ),
    "test_multi_goal_accept": "test_several_goals_at_once_all_succeed",
    "test_duplicate_goal": (
        "test_an_id_in_use_is_rejected_while_the_goal_runs_and_while_it_is_remembered"
    ),
    "test_cancel_goal_accept": "test_a_cancel_is_accepted_and_the_goal_ends_as_canceled",
    "test_cancel_goal_reject": "test_a_refused_cancel_says_so_and_the_goal_goes_on",
    "test_cancel_defered_goal": "test_a_goal_whose_execution_is_deferred_can_be_canceled",
    "test_execute_succeed": "test_feedback_arrives_in_order_and_the_result_after_it",
    "test_execute_abort": "test_an_abort_comes_with_the_part_that_is_done",
    "test_execute_no_terminal_state": (
        "test_an_executor_that_goes_wrong_is_aborted_with_an_empty_result"
    ),
    "test_execute_raises_exception": (
        "test_an_executor_that_goes_wrong_is_aborted_with_an_empty_result"
    ),
    "test_expire_goals_none": "test_a_result_can_be_asked_for_late_and_again",
    "test_expire_goals_one": "test_a_result_expires_and_then_the_id_is_free_again",
    "test_expire_goals_multi": "test_a_result_expires_and_then_the_id_is_free_again",
    "test_feedback": "test_feedback_arrives_in_order_and_the_result_after_it",
    "test_different_feedback_type_raises": (
        "test_an_executor_that_goes_wrong_is_aborted_with_an_empty_result"
    ),
    "test_without_execute_cb": "a goal of fibaction is executed by its executor only",
    "test_action_introspection_default_status": (
        "test_services_publish_no_events_of_introspection"
    ),
    "test_configure_introspection_content": INTROSPECTION,
}
CLIENT: dict[str, str] = {
    "test_constructor_defaults": RCLPY_API,
    "test_constructor_no_defaults": RCLPY_API,
    "test_get_num_entities": OWN_ENTITIES,
    "test_wait_for_server_nowait": "test_a_server_that_is_not_there_is_not_found",
    "test_wait_for_server_timeout": "test_a_server_that_is_not_there_is_not_found",
    "test_wait_for_server_exists": "test_a_server_that_is_there_is_found_at_once",
    "test_send_goal_async": "test_feedback_arrives_in_order_and_the_result_after_it",
    "test_send_goal_async_with_feedback_after_goal": (
        "test_feedback_arrives_in_order_and_the_result_after_it"
    ),
    "test_send_goal_async_with_feedback_before_goal": (
        "test_several_goals_run_side_by_side_and_each_gets_its_own"
    ),
    "test_send_goal_async_with_feedback_after_goal_result_requested": (
        "fibaction asks for the result by itself, and feedback is delivered until the goal ends"
    ),
    "test_send_goal_async_with_feedback_for_another_goal": (
        "test_several_goals_run_side_by_side_and_each_gets_its_own"
    ),
    "test_send_goal_async_with_feedback_for_not_a_goal": (
        "test_several_goals_run_side_by_side_and_each_gets_its_own"
    ),
    "test_send_goal_multiple": "test_several_goals_run_side_by_side_and_each_gets_its_own",
    "test_send_goal_async_no_server": "test_a_server_that_is_not_there_is_not_found",
    "test_send_cancel_async": ("test_an_accepted_cancel_ends_the_goal_with_the_part_that_is_done"),
    "test_get_result_async": "test_feedback_arrives_in_order_and_the_result_after_it",
    "test_different_type_raises": "test_a_goal_of_another_type_is_rejected_before_it_is_sent",
    "test_action_introspection_default_status": (
        "the services of the stock server are rclpy's own; ours are looked at in the other half"
    ),
    "test_configure_introspection_content": INTROSPECTION,
}
GRAPH: dict[str, str] = dict.fromkeys(
    (
        "test_get_action_client_names_and_types_by_node",
        "test_get_action_server_names_and_types_by_node",
        "test_get_action_names_and_types",
    ),
    "test_the_graph_shows_the_action_its_server_and_its_client",
)
MISMATCHED = {"test_cancel_defered_goal"}
"""Of the server's tests those that are run by our client: our server defers nothing."""


@pytest.mark.parametrize(
    ("listed", "module"), [(SERVER, server), (CLIENT, client), (GRAPH, server)]
)
def test_what_is_said_to_be_tested_is_tested(listed: dict[str, str], module: ModuleType) -> None:
    for name, where in listed.items():
        if where.startswith("test_"):
            assert hasattr(client if name in MISMATCHED else module, where), name
        else:
            assert " " in where, f"{name} has no reason"


def test_the_list_is_complete() -> None:
    assert (len(SERVER), len(CLIENT), len(GRAPH)) == (23, 19, 3)
