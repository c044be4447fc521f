"""Names of actions: looked up, suggested and shown."""

from __future__ import annotations

import pytest

from fibaction import ActionInfo
from fibaction.cli.arguments.action_names import no_action
from fibaction.cli.process.exit_codes import ExitCode
from tests.cli.conftest import Run


@pytest.mark.parametrize(
    "verb",
    [
        *(["type"], ["send_goal"], ["goals"], ["goals", "-w"], ["info"], ["echo"]),
        *(["cancel", "--all"], ["cancel"], ["attach", "aa"]),
    ],
    ids=lambda verb: " ".join(verb),
)
def test_every_verb_suggests_the_near_name(here: Run, tcp: str, verb: list[str]) -> None:
    rest = ["aa"] if verb == ["cancel"] else []
    code, out, err = here(*verb, "fibonaci", *rest, url=tcp)

    assert (code, out) == (ExitCode.UNREACHABLE, "")
    assert err == "Error: the action /fibonaci is not served; did you mean /fibonacci?\n"


@pytest.mark.parametrize(
    ("known", "text"),
    [
        ([], "the action /x is not served, nor is any other"),
        (["jump", "run"], "the action /x is not served; there is /jump, /run"),
        (
            [f"jump{i:02}" for i in range(12)],
            "the action /x is not served; there is "
            + ", ".join(f"/jump{i:02}" for i in range(10))
            + ", ...",
        ),
    ],
)
def test_where_no_name_is_near_there_is_a_list(known: list[str], text: str) -> None:
    assert no_action("x", map(ActionInfo, known)).message == text
