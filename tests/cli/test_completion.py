"""What the shell completes, also in a namespace."""

from __future__ import annotations

from pathlib import Path

import anyio
import pytest
from click.shell_completion import BashComplete

from fibaction import ActionInfo
from fibaction.cli.app import cli
from fibaction.cli.arguments import completion
from fibaction.cli.process.exit_codes import ExitCode
from tests.cli.conftest import Run, detached


def complete(run: Run, words: str, url: str) -> list[str]:
    """What bash is offered for the last of the words."""
    count = len(words.split(" ")) - 1
    env = {
        "_FIBACTION_COMPLETE": "bash_complete",
        "COMP_WORDS": words,
        "COMP_CWORD": str(count),
    }
    code, out, err = run(url=url, env=env)
    assert (code, err) == (0, "")
    return [line.partition(",")[2] for line in out.split()]


def offered_by_shell(words: list[str], incomplete: str) -> list[str]:
    """What click offers for the incomplete word behind the others."""
    shell = BashComplete(cli, {}, "fibaction", "_FIBACTION_COMPLETE")
    return [item.value for item in shell.get_completions(words, incomplete)]


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("fibaction se", ["serve", "send_goal", "service"]),
        ("fibaction send_goal --de", ["--detach"]),
        ("fibaction send-goal fib", ["fibonacci"]),
        ("fibaction send_goal /fib", ["/fibonacci"]),
        ("fibaction info w", ["wait", "words"]),
        ("fibaction type arm/", ["arm/pick"]),
        ("fibaction find arm", ["arm/action/Pick", "arm/action/Wait"]),
        ("fibaction send_goal wait a", ["arm/action/Wait"]),
        ("fibaction send_goal /wait a", ["arm/action/Wait"]),
        ("fibaction nonsense x", []),
    ],
)
def test_verbs_options_actions_and_types_are_completed(
    here: Run, tcp: str, words: str, offered: list[str]
) -> None:
    assert complete(here, words, tcp) == offered


def test_where_no_server_is_nothing_is_completed(here: Run, nobody: str) -> None:
    assert complete(here, "fibaction info fib", nobody) == []
    assert complete(here, "fibaction info fib", "nonsense") == []


def test_a_server_that_does_not_answer_is_not_waited_for() -> None:
    listening: list[str] = []

    async def silence() -> list[str]:
        async with await anyio.create_tcp_listener(local_host="127.0.0.1") as on_next:
            port = on_next.extra(anyio.abc.SocketAttribute.local_port)
            listening.append(f"tcp://127.0.0.1:{port}")
            return [info.name for info in await completion.actions_at(listening[0], 0.05)]

    assert anyio.run(silence) == []


def test_a_goal_to_fill_in_is_offered_quoted_as_the_shell_needs_it(
    monkeypatch: pytest.MonkeyPatch, tcp: str
) -> None:
    def offered(*words: str) -> list[str]:
        return offered_by_shell(["-u", tcp, *words], "")

    monkeypatch.setenv("_FIBACTION_COMPLETE", "bash_complete")
    assert offered("send_goal", "many") == ["""'{"count": 50000}'"""]
    assert offered("send_goal", "/wait", "arm/action/Wait") == [
        """'{"seconds": 3600.0, "steps": 1}'"""
    ]
    assert offered("send_goal", "words") == []  # its default would be changed by a shell
    for name in ("zsh", "fish"):
        monkeypatch.setenv("_FIBACTION_COMPLETE", f"{name}_complete")
        assert offered("send_goal", "many") == ['{"count": 50000}']


def test_ids_of_goals_are_offered_where_one_is_needed(here: Run, tcp: str, nobody: str) -> None:
    running = detached(here, tcp, "wait", "{seconds: 60, steps: 600}")
    over = detached(here, tcp, "fibonacci", "order: 1")

    def offered(words: list[str], incomplete: str, url: str = tcp) -> list[str]:
        return offered_by_shell(["-u", url, *words], incomplete)

    assert {running, over} <= set(offered(["attach"], ""))
    assert offered(["attach"], over[:20].upper()) == [over]
    assert {running, "wait", "arm/pick"} <= set(offered(["cancel"], ""))
    assert over not in offered(["cancel"], "")  # it has ended
    assert running in offered(["cancel", "wait"], "")
    assert offered(["cancel", "fibonacci"], "") == []
    assert offered(["cancel", "nothing"], "") == offered(["attach"], "", nobody) == []
    here("cancel", running, url=tcp)


def test_a_server_that_does_not_list_its_goals_is_not_waited_for(tcp: str) -> None:
    assert anyio.run(completion.goals_at, tcp, None, 0) == []


def test_names_of_addresses_are_completed_and_used(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tcp: str
) -> None:
    monkeypatch.setenv("FIBACTION_CONFIG", str(tmp_path / "config.toml"))
    offered = offered_by_shell
    assert offered(["-c"], "") == offered(["-c", "robot1", "info"], "") == []
    (tmp_path / "config.toml").write_text(f'[addresses]\nrobot1 = "{tcp}"\narm = "tcp://x"\n')
    assert offered(["-c"], "") == ["arm", "robot1"]
    assert offered(["-c"], "r") == ["robot1"]
    assert offered(["-c", "robot1", "info"], "w") == ["wait", "words"]
    assert offered(["-c", "robot2", "attach"], "") == []
    (tmp_path / "config.toml").write_text("nonsense")
    assert offered(["-c"], "") == []


HOSTILE = [
    *("a\nplain,b", "a b", "$(touch x)", "`touch x`", "${HOME}", "*", "a;b", "a&b", "a|b", "a>b"),
    *(
        "~root",
        "'",
        '"',
        "\\",
        "!!",
        "#a",
        "a{b,c}",
        "[a]",
        "-x",
        "a\x1b[2J",
        "a\u202e",
        "ü",
        "x" * 201,
    ),
    *("a:b", "a,b", "=ls", "(a)", "\0", "\ud800", "x" * 201),
]


def test_names_that_a_shell_would_change_are_not_offered() -> None:
    good = [ActionInfo("d"), ActionInfo("/arm/pick_up2", "arm/action/Pick")]
    wrong = [ActionInfo(name) for name in HOSTILE]

    assert completion.plain([*wrong, *good, *[ActionInfo("c", name) for name in HOSTILE]]) == good


def test_the_names_of_many_actions_are_offered_in_part() -> None:
    many = [ActionInfo(f"a{number}") for number in range(completion.MOST_OFFERED + 1)]

    assert completion.plain(many) == many[:-1]


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
