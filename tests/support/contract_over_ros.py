"""The tests of the contract over a transport of ROS 2, with fibaction at both ends.

What ROS 2 cannot keep is left out by `EXCLUSIONS`. A module of tests takes all names of
`contract_over`.
"""

from __future__ import annotations

import uuid
from importlib import import_module
from typing import Any

import pytest

from fibaction.testing.contract import TRANSPORTS
from fibaction.testing.contract.reach import Reach, directly, through_a_gateway
from tests.contract.conftest import anyio_backend
from tests.support.executors import Form, as_generator

REASON = "ROS 2's answers have no field for a reason"
AGAIN = "a second goal with the ID of another is rejected, as rcl_action does"
DEFAULT = "every field has a value in ROS 2, so one that is left out has its default"
SAME = "the types of both ends are the same in ROS 2"
TYPE = "an action without a ROS type cannot be served"
HOLD = "feedback is broadcast, and no client can make a server wait"
NUMBER = "feedback is not numbered, so what was lost on the way cannot be counted"
PAST = "feedback of the past is not kept for those who come late"
ERRORS = "ROS 2's answers have no field for an error"
SENDER = "a request of ROS 2 does not name its client"
GOALS = "no topic has the goals"
PLACE = "a list of statuses has no field for the place of a goal"
TIMES = "a list of statuses has no fields for times and reasons"
TIMEOUT = "a request with a goal has no field for a timeout"
META = "a request with a goal has no field for a meta"
STOPPED = "a server that has stopped still rejects goals, as long as its node is there"

EXCLUSIONS: dict[str, str] = {
    "test_lists_and_followers_are_told_the_parent_of_a_child_also_after_its_end": META,
    "test_lists_have_the_labels_of_a_goal_also_after_its_end": META,
    "test_an_observer_gets_the_goal_itself_while_it_is_active": GOALS,
    "test_on_goal_sees_the_goal_and_its_reason_reaches_the_client": REASON,
    "test_a_callback_that_fails_rejects_the_goal_and_the_server_goes_on": REASON,
    "test_a_callback_that_returns_something_rejects_the_goal": REASON,
    "test_a_rejected_goal_sent_again_is_rejected_again_without_a_second_decision": REASON,
    "test_a_cancel_is_raised_at_an_await_and_the_part_that_is_done_is_kept": REASON,
    "test_clean_up_that_raises_is_aborted_with_the_reason": REASON,
    "test_a_rejected_cancel_leaves_the_goal_running": REASON,
    "test_a_cancel_callback_that_fails_rejects": REASON,
    "test_cancel_all_tells_the_truth_when_some_reject": REASON,
    "test_leaving_the_block_of_a_goal_whose_cancel_is_rejected_is_logged": REASON,
    "test_stopping_ends_every_goal_as_aborted_and_answers_every_client": REASON,
    "test_a_goal_that_is_sent_while_the_server_stops_is_rejected": REASON,
    "test_an_executor_that_does_not_stop_in_time_is_killed": REASON,
    "test_an_executor_that_goes_wrong_is_aborted_with_the_reason": REASON,
    "test_a_goal_without_a_place_is_told_how_many_run_and_wait": REASON,
    "test_a_list_of_goals_tells_the_places_of_those_that_wait": PLACE,
    "test_a_list_of_goals_tells_their_begins_and_ends_and_the_reasons": TIMES,
    "test_a_preempted_goal_is_told_by_which": REASON,
    "test_a_replaced_goal_is_told_by_which": REASON,
    "test_a_goal_that_is_too_late_is_told_how_long_it_had": REASON,
    "test_a_goal_is_told_which_function_of_the_schedule_has_failed": REASON,
    "test_the_same_goal_sent_again_gets_the_same_answer_and_runs_once": AGAIN,
    "test_the_same_goal_sent_again_while_it_is_decided_waits_for_that": AGAIN,
    "test_another_goal_under_an_id_in_use_is_rejected": AGAIN,
    "test_another_client_that_sends_a_running_goal_again_observes_it": AGAIN,
    "test_a_goal_of_the_wrong_type_is_rejected_and_the_reason_names_the_field": DEFAULT,
    "test_a_client_whose_type_has_a_field_more_is_understood": SAME,
    "test_a_large_goal_of_a_client_without_types_is_decided_after_its_check": TYPE,
    "test_an_action_that_is_not_served_is_not_found_and_can_be_waited_for": TYPE,
    "test_several_actions_share_one_connection": TYPE,
    "test_an_executor_that_never_awaits_starves_no_other_and_can_be_canceled": TYPE,
    "test_the_executor_waits_at_its_yield_for_a_client_that_does_not_read": HOLD,
    "test_a_client_that_stalls_loses_the_oldest_and_is_told_how_many": HOLD,
    "test_a_client_that_has_caught_up_loses_nothing_again": HOLD,
    "test_a_goal_whose_feedback_is_not_read_delays_no_other_goal": HOLD,
    "test_latest_never_waits_and_a_slow_reader_sees_the_newest": NUMBER,
    "test_an_observer_follows_from_now_on_and_does_not_slow_the_goal_down": NUMBER,
    "test_an_observer_may_ask_for_what_was_before": PAST,
    "test_the_feedback_of_a_goal_that_has_ended_can_be_asked_for": PAST,
    "test_a_watcher_of_all_goals_sees_the_feedback_of_one_that_ends_at_once": PAST,
    "test_two_clients_are_two_senders": SENDER,
    "test_the_sender_has_the_name_of_its_token_and_its_address": SENDER,
    "test_a_server_that_has_stopped_is_not_found": STOPPED,
    "test_the_executor_sees_the_deadline": TIMEOUT,
    "test_the_meta_of_a_goal_reaches_the_watchers": META,
    "test_the_meta_of_a_child_names_its_parent": META,
    "test_a_meta_over_the_limits_is_an_error_and_nothing_is_sent": META,
    "test_a_trace_leads_from_the_client_to_the_spans_of_the_executor": META,
    "test_spans_that_are_held_across_a_yield_are_closed_in_their_context": META,
    "test_a_goal_that_is_sent_again_keeps_its_first_deadline": TIMEOUT,
    "test_a_rejection_of_a_busy_server_is_not_its_last_word": REASON,
    "test_a_goal_whose_acceptance_was_lost_is_sent_again_and_runs_once": AGAIN,
    "test_a_goal_that_is_lost_behind_the_server_is_followed_again": ERRORS,
    "test_every_error_of_the_table_is_shown_here": ERRORS,
    "test_an_error_of_an_endpoint_arrives_as_itself": ERRORS,
    "test_a_rejection_of_an_endpoint_arrives_with_its_reason_and_goal": ERRORS,
    "test_an_error_that_only_the_server_knows_arrives_as_its_nearest_base": ERRORS,
}
"""The tests that ROS 2 cannot keep, each with the reason."""

MODULES = [*TRANSPORTS, "tests.contract.test_ros_messages", "tests.contract.test_tracing"]
PATIENCE = 45.0
"""Seconds for a thousand goals, which take some 6 s, and several times that on a busy machine."""


def contract_over(scheme: str, more: str = "") -> dict[str, Any]:
    """Return the tests and their fixtures, by the names that a module has them under. `more` is
    what the URL of a server has at its end, and that of a client has not.
    """

    def address() -> str:
        """Return a URL with a namespace of its own."""
        return f"{scheme}://?namespace=/t{uuid.uuid4().hex}{more}"

    ways = {
        scheme: Reach(directly, address, patience=PATIENCE),
        f"gateway to {scheme}": Reach(through_a_gateway, address, patience=PATIENCE),
    }

    @pytest.fixture(params=list(ways))
    def reach(request: pytest.FixtureRequest) -> Reach:
        return ways[request.param]

    tests = {
        name: test
        for module in map(import_module, MODULES)
        for name, test in vars(module).items()
        if name.startswith("test_") and name not in EXCLUSIONS
    }
    return {
        "pytestmark": pytest.mark.anyio,
        "anyio_backend": anyio_backend,
        "form": form,
        "reach": reach,
        **tests,
    }


@pytest.fixture
def form() -> Form:
    """Return the form of the executors: no way can tell it behind the server."""
    return as_generator
