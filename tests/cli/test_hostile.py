"""The command and a server that sends whatever could harm it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from socket import create_server

import pytest

from fibaction.cli.output.yaml_text import MAX_VALUES
from fibaction.cli.process.exit_codes import ExitCode
from tests.cli.conftest import Invoke, Open, Run, running

MOST = 3000
"""Characters of a line of output that is not a message in full."""


@pytest.fixture(scope="module")
def start() -> Iterator[Callable[..., str]]:
    """Start a server with actions of these kinds; give its URL."""
    with running() as run:
        yield lambda *kinds: run("tests.cli.hostile_server", *kinds, until="tcp")[1][0].strip()


@pytest.fixture(scope="module")
def hostile(start: Callable[..., str]) -> str:
    """A server with a few hostile actions."""
    return start("cycle", "deep", "doubled", "pattern", "defaults", "odd", "names", "plain")


@pytest.fixture(scope="module")
def crowd(start: Callable[..., str]) -> str:
    """A server with 2,000 actions that have long names with control characters."""
    return start("many")


@pytest.mark.parametrize(
    ("action", "goal", "text"),
    [
        ("cycle", '{"b": 1}', 'the schema of the goal refers to itself without end, by "#"'),
        (
            "doubled",
            '{"b": 1}',
            "the schema of the goal is too complex: a check by it takes over 20,",
        ),
        ("defaults", "{}", "the schema of the goal has too many defaults: in this message they"),
        ("odd", '{"b": 1}', 'the schema of the goal is malformed: "properties" cannot be []'),
        ("names", '{"b": 1}', 'goal has no field "b"; it has xxx'),
    ],
)
def test_a_hostile_schema_is_one_short_sentence(
    here: Run, hostile: str, action: str, goal: str, text: str
) -> None:
    code, out, err = here("send_goal", action, goal, url=hostile)

    assert (code, out) == (ExitCode.USAGE, "")
    assert err.startswith(f"Error: {text}")
    assert len(err) < MOST
    assert err.removesuffix("\n").isprintable()


@pytest.mark.parametrize(
    ("action", "goal"), [("deep", "[[[]]]"), ("pattern", f"text: {'a' * 50}b")]
)
def test_a_goal_that_a_hostile_schema_allows_is_sent(
    here: Run, hostile: str, action: str, goal: str
) -> None:
    done = here("send_goal", action, goal, "--detach", url=hostile)

    assert done.code in (ExitCode.SUCCEEDED, ExitCode.REJECTED)


def test_nothing_is_fetched_that_a_server_names(
    here: Run, start: Callable[..., str], tmp_path: Path
) -> None:
    secret = tmp_path / "secret.json"
    secret.write_text('{"title": "secret"}')
    with closing(create_server(("127.0.0.1", 0))) as listener:
        listener.setblocking(False)
        address = f"http://127.0.0.1:{listener.getsockname()[1]}/schema.json"
        url = start(address, secret.as_uri())
        for action in ("http", "file"):
            code, out, err = here("send_goal", action, "{}", url=url)
            assert (code, out) == (ExitCode.USAGE, "")
            assert "which is outside of it" in err
            assert "title" not in err
        with pytest.raises(BlockingIOError):
            listener.accept()


@pytest.mark.parametrize("kind", ["wide", "nested", "text"])
def test_large_messages_are_shown_in_part(here: Run, hostile: str, kind: str) -> None:
    code, out, err = here("send_goal", "plain", f"do: {kind}", "-f", url=hostile)

    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert max(map(len, lines)) < MOST
    assert len(lines) < MAX_VALUES + 100
    assert lines[-1] == "Goal finished with status: SUCCEEDED"


@pytest.mark.parametrize("kind", ["wide", "nested", "text"])
def test_large_feedback_on_a_live_line_is_shown_in_part(
    terminal: Open, hostile: str, kind: str
) -> None:
    assert terminal("send_goal", "plain", f"do: {kind}", "-f", url=hostile).ends() == 0


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("list", "-t"), 0),
        (("goals",), 0),
        (("info", "x"), ExitCode.UNREACHABLE),
        (("info", "\udc80"), ExitCode.UNREACHABLE),
        (("type", "y" * 5000), ExitCode.UNREACHABLE),
        (("find", "x"), 0),
        (("cancel", "--all"), 0),
    ],
)
def test_names_are_shown_in_part_and_cannot_control_the_terminal(
    invoke: Invoke, crowd: str, arguments: tuple[str, ...], code: int
) -> None:
    result = invoke(*arguments, url=crowd)

    assert result.exit_code == code, result.output
    lines = result.output.split("\n")
    assert max(map(len, lines)) < MOST
    assert all(line.isprintable() for line in lines)


def test_top_shows_some_of_many_actions_and_reacts(terminal: Open, crowd: str) -> None:
    top = terminal("top", url=crowd, columns=160)
    top.until(r"x1b\[2J")
    top.press("q")

    assert top.ends() == 0, top.text[-500:]
