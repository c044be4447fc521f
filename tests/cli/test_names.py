"""Names of actions and namespaces: looked up, suggested, shown, and wrong ones."""

from __future__ import annotations

import pytest

from fibaction import ActionInfo, ServerNotFound
from fibaction.cli.arguments import names as module
from fibaction.cli.arguments.names import (
    ROOT,
    Namespace,
    namespace_of,
    namespaces_of,
    no_action,
    no_namespace,
)
from fibaction.cli.process.exit_codes import ExitCode, Failure
from tests.cli.served import Served, counter


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


NAMES = ["/robot1/navigate", "robot2/navigate", "robot2/arm/pick", "robot10/navigate", "look"]


def held(namespace: str) -> list[str]:
    return [name for name in NAMES if Namespace.parse(namespace).holds(name)]


def test_a_namespace_holds_names_that_begin_with_all_of_its_parts() -> None:
    assert held("/robot1") == ["/robot1/navigate"]
    assert held("/robot2") == ["robot2/navigate", "robot2/arm/pick"]
    assert held("/robot2/arm") == ["robot2/arm/pick"]
    assert held("/robot") == held("/look") == held("/navigate") == []
    assert held("/") == NAMES


def test_slashes_at_the_ends_of_a_namespace_are_optional() -> None:
    assert Namespace.parse("robot1") == Namespace.parse("robot1/") == Namespace("/robot1")
    assert Namespace.parse("/robot2/arm/") == Namespace("/robot2/arm")
    assert Namespace.parse("/") == ROOT


@pytest.mark.parametrize("text", ["", "//", "/robot1//arm", "/robot 1", "/1", "~", "~/arm", "/a\n"])
def test_what_is_not_a_namespace_is_one_sentence(text: str) -> None:
    with pytest.raises(Failure, match="a namespace is like /robot1 or ") as no:
        Namespace.parse(text)

    assert no.value.exit_code == ExitCode.USAGE


def test_a_name_without_a_slash_in_front_is_relative_as_in_ros() -> None:
    robot = Namespace("/robot2")

    assert robot.absolute("navigate") == "/robot2/navigate"
    assert robot.absolute("arm/pick") == "/robot2/arm/pick"
    assert robot.absolute("/robot1/navigate") == "/robot1/navigate"
    assert robot.absolute("~/jump") == "~/jump"
    assert ROOT.absolute("look") == "/look"
    assert robot.relative("robot2/arm/pick") == "arm/pick"
    assert ROOT.relative("robot2/arm/pick") == "robot2/arm/pick"


def test_each_action_is_in_one_namespace_itself_and_in_those_around_it() -> None:
    assert [namespace_of(name) for name in NAMES] == [
        *("/robot1", "/robot2", "/robot2/arm", "/robot10", "/")
    ]
    assert namespaces_of([*NAMES, "~/jump"]) == {"/robot1", "/robot2", "/robot2/arm", "/robot10"}


@pytest.mark.asyncio
async def test_a_narrow_connection_lists_the_actions_of_its_namespace() -> None:
    served = Served(*map(counter, NAMES))
    narrow = Namespace("/robot2").narrow(served.connection)

    found = await narrow.actions()
    assert [info.name for info in found] == ["robot2/navigate", "robot2/arm/pick"]
    assert narrow.endpoint(found[0]) is served.servers["robot2/navigate"]
    assert len(await ROOT.narrow(served.connection).actions()) == len(NAMES)


@pytest.mark.asyncio
async def test_a_namespace_that_had_actions_may_lose_them_but_one_that_never_had_is_an_error() -> (
    None
):
    served = Served(counter("robot1/navigate"), counter("robot2/navigate"))
    robot1, robot3 = (Namespace(f"/robot{n}").narrow(served.connection) for n in (1, 3))
    await robot1.actions()
    del served.servers["robot1/navigate"]

    assert await robot1.actions() == []
    with pytest.raises(Failure, match="there is no action in the namespace /robot3") as failure:
        await robot3.actions()
    assert failure.value.exit_code == ExitCode.UNREACHABLE
    served.error = ServerNotFound("nobody is there")
    with pytest.raises(ServerNotFound):
        await robot1.actions()


class Robots(Served):
    """A network with a node in `/robot3`, whose action comes with the third look."""

    looks = 0

    async def actions(self) -> list[ActionInfo]:
        self.looks += 1
        if self.looks == 3:
            self.servers["robot3/navigate"] = counter("robot3/navigate")
        return await super().actions()

    async def nodes(self) -> set[str]:
        return {"/robot3/camera", "/robot30/camera"}


@pytest.mark.asyncio
async def test_the_first_action_of_a_namespace_is_waited_for_if_it_has_a_node() -> None:
    served = Robots(counter("robot1/navigate"))
    found = await Namespace("/robot3").narrow(served.connection).actions()
    assert [info.name for info in found] == ["robot3/navigate"]
    with pytest.raises(Failure, match="in the namespace /robot4; did you mean /robot3"):
        await Namespace("/robot4").narrow(served.connection).actions()


@pytest.mark.asyncio
async def test_a_namespace_whose_nodes_serve_nothing_is_told_with_its_nodes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "LATE", 0.0)
    served = Robots(counter("robot1/navigate"))
    with pytest.raises(Failure) as caught:
        await Namespace("/robot3").narrow(served.connection).actions()
    text = "there is no action in the namespace /robot3 yet, only nodes that serve none"
    assert caught.value.message == f"{text}: /robot3/camera"
    nodes = [f"/robot3/n{number:02}" for number in range(11)]
    message = no_namespace(Namespace("/robot3"), (), nodes).message
    assert message == f"{text}: {', '.join(nodes[:10])}, ..."


@pytest.mark.parametrize(
    ("known", "text"),
    [
        (NAMES, "; did you mean /robot1?"),
        (["lab/look", "yard/look"], "; there is /lab, /yard"),
        (
            [f"a{n:02}/look" for n in range(11)],
            f"; there is {', '.join(f'/a{n:02}' for n in range(10))}, ...",
        ),
        (["look", "go"], "; the actions here have no namespace, leave out -n: go, look"),
        (
            [f"a{n:02}" for n in range(11)],
            "; the actions here have no namespace, leave out -n: "
            + ", ".join(f"a{n:02}" for n in range(10))
            + ", ...",
        ),
        ([], ", and no action is served here"),
        (["lab\x1b/look"], "; there is /lab\\x1b"),
    ],
)
def test_where_a_namespace_is_not_there_a_near_one_is_suggested(
    known: list[str], text: str
) -> None:
    message = no_namespace(Namespace("/robt1"), known).message

    assert message == f"there is no action in the namespace /robt1{text}"


def test_names_with_very_many_parts_take_little_time() -> None:
    names = ["a/" * 1_000_000 + str(number) for number in range(10)]

    assert len(namespaces_of(names)) == 50
    assert len(no_namespace(Namespace("/robot1"), names).message) <= 2000
