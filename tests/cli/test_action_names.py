"""Names of actions: looked up, suggested and shown."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from fibaction import ActionInfo, connect, serve
from fibaction.cli.arguments.action_names import find_action, names_of, no_action, shown
from fibaction.cli.process.exit_codes import ExitCode, Failure
from tests.cli.conftest import Run
from tests.cli.robot import servers


@pytest.mark.asyncio
async def test_a_slash_in_front_of_a_name_is_optional_and_a_near_name_is_suggested() -> None:
    async with serve(servers(), "inproc://names"), connect("inproc://names") as connection:
        for name in ("fibonacci", "/fibonacci", "arm/pick", "/arm/pick"):
            assert (await find_action(connection, name)).name == name.lstrip("/")
        with pytest.raises(Failure) as failure:
            await find_action(connection, "fibonaci")

    assert failure.value.message == "the action /fibonaci is not served; did you mean /fibonacci?"
    assert failure.value.exit_code == ExitCode.UNREACHABLE


@pytest.mark.parametrize(
    "verb",
    [
        *(["type"], ["send_goal"], ["goals"], ["goals", "-w"]),
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


def test_names_are_shown_as_ros_does_and_cleaned() -> None:
    names = ("arm/pick", "/count", "a\x1b")
    endpoints: Any = [SimpleNamespace(info=ActionInfo(name)) for name in names]

    assert names_of(endpoints) == "/arm/pick, /count, /a\\x1b"
    assert shown("~/jump") == "~/jump"


def test_names_that_take_long_to_compare_are_not_suggested() -> None:
    actions = [ActionInfo("x" * 1_000_000 + str(number)) for number in range(20)]

    assert "did you mean" not in no_action("x" * 1_000_000, actions).message
    message = no_action("arm", actions).message
    assert message.startswith("the action /arm is not served; there is /xxx")
    assert len(message) <= 2000
