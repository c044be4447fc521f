"""The option `--namespace`: the same in each verb that has it, and completed by the shell."""

from __future__ import annotations

import pytest

from fibaction import ActionInfo
from fibaction.cli.arguments import completion
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import top
from tests.cli.conftest import Run
from tests.cli.test_completion import offered_by_shell
from tests.cli.test_top import sys_with_terminals

VERBS = [
    ["list"],
    ["goals"],
    ["goals", "-w"],
    ["top"],
    ["bridge", "URL", "unix:///tmp/never"],
    ["attach", "12ab"],
    ["cancel", "12ab"],
    ["cancel", "--all"],
]


@pytest.fixture(autouse=True)
def in_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """`top` finds a terminal, which it does not come to use."""
    monkeypatch.setattr(top, "sys", sys_with_terminals())


@pytest.mark.parametrize("option", ["-n", "--namespace"])
@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_every_verb_suggests_the_near_namespace(
    here: Run, tcp: str, verb: list[str], option: str
) -> None:
    words = [tcp if word == "URL" else word for word in verb]
    code, out, err = here(*words, option, "/amr", url=tcp)

    assert (code, out) == (ExitCode.UNREACHABLE, "")
    assert err == "Error: there is no action in the namespace /amr; did you mean /arm?\n"


@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_every_verb_rejects_what_is_not_a_namespace(here: Run, tcp: str, verb: list[str]) -> None:
    words = [tcp if word == "URL" else word for word in verb]
    code, out, err = here(*words, "-n", "/robot 1", url=tcp)

    assert (code, out) == (ExitCode.USAGE, "")
    assert err == "Error: a namespace is like /robot1 or /robot1/arm, unlike '/robot 1'\n"


def test_names_are_relative_to_the_namespace(here: Run, tcp: str) -> None:
    goal_id = here("send_goal", "pick", "object_name: cup", "--detach", "-n", "/arm", url=tcp).out
    assert here("attach", goal_id.strip(), "pick", "-n", "/arm", url=tcp).code == 0
    assert here("attach", goal_id.strip(), "-n", "/arm", url=tcp).code == 0
    assert here("info", "pick", "-n", "arm", url=tcp).lines[0] == "Action: /arm/pick"
    assert here("info", "/wait", "-n", "arm", url=tcp).lines[0] == "Action: /wait"
    done = here("cancel", "pick", goal_id.strip(), "-n", "/arm", url=tcp)
    text = f"The goal {goal_id.strip()} of /arm/pick is not canceled: it has ended already\n"
    assert (done.code, done.err) == (ExitCode.ABORTED, text)
    assert here("cancel", "pick", "--all", "-n", "/arm", url=tcp).err == (
        "There is no goal to cancel.\n"
    )
    _, _, err = here("echo", "pic", "-n", "/arm", url=tcp)
    assert "the action /arm/pic is not served; did you mean /arm/pick?" in err


# Completion

FLEET = {
    "tcp://fleet": ["robot1/navigate", "robot2/navigate", "robot2/arm/pick", "look"],
    "tcp://other": ["other/look"],
}


def offered(words: str) -> list[str]:
    """What the shell offers for the last word."""
    *before, incomplete = words.split(" ")
    return offered_by_shell(before, incomplete)


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two servers with namespaces, as completion sees them."""

    async def actions_at(url: str) -> list[ActionInfo]:
        return list(map(ActionInfo, FLEET[url]))

    monkeypatch.setattr(completion, "actions_at", actions_at)
    monkeypatch.setenv("FIBACTION_URL", "tcp://fleet")


@pytest.mark.usefixtures("fleet")
def test_namespaces_are_completed_as_they_are_begun() -> None:
    for verb in ("list", "goals", "top"):
        assert offered(f"{verb} -n ") == ["/robot1", "/robot2", "/robot2/arm"]
    assert offered("list -n /robot2") == ["/robot2", "/robot2/arm"]
    assert offered("list --namespace robot2/") == ["robot2/arm"]
    assert offered("list -n /nowhere") == []
    assert offered("list -u tcp://other -n ") == ["/other"]


@pytest.mark.usefixtures("fleet")
def test_a_bridge_completes_from_the_url_that_it_bridges() -> None:
    assert offered("bridge tcp://other tcp://fleet -n ") == ["/other"]
    assert offered("bridge tcp://other --namespace=/o") == ["/other"]
    assert offered("bridge -n ") == []
    assert offered("bridge tcp://fleet tcp://other -n /robot2 ") == ["navigate", "arm/pick"]


@pytest.mark.usefixtures("fleet")
def test_names_are_completed_relative_to_the_namespace() -> None:
    assert offered("goals -n /robot2 ") == ["navigate", "arm/pick"]
    assert offered("goals -n robot2 a") == ["arm/pick"]
    assert offered("goals -n robot2 /robot1") == ["/robot1/navigate"]
    assert offered("goals -n /2 robot1") == ["robot1/navigate"]  # the namespace is rejected later
