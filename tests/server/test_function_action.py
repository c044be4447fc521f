"""`action`: plain functions as executors, the types that are read from them, and their threads."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import threading
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Generator
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypedDict, cast

import anyio
import attrs
import msgspec
import pydantic
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    FunctionAction,
    GoalCanceled,
    GoalHandle,
    GoalStatus,
    Outcome,
    ProtocolError,
    Report,
    Return,
    action,
)
from fibaction.server import actions_of
from fibaction.server.functions import function_action
from fibaction.testing import run_executor
from tests.support.matching import End

pytestmark = pytest.mark.anyio


class Pose(msgspec.Struct):
    x: float


@action
async def drive(report: Report[int], meters: int) -> str:
    """Drive some meters."""
    for done in range(1, meters + 1):
        await report(done)
    return f"drove {meters} m"


@action
async def pick(what: str, force: float, report: Report[float]) -> list[float]:
    await report(force)
    return [force, len(what)]


@action
async def place(what: Annotated[str, "the name of a part"], force: float = 1.0) -> list[float]:
    return [force, len(what)]


@action
async def home() -> None:
    return


@action("look")
def look(goal: GoalHandle[Pose]) -> Pose:
    return Pose(goal.request.x * 2)


@action("move", type_name="my_robot/action/Move", checkpoint=int)
async def move(pose: Pose, goal: GoalHandle[Pose], report: Report[Pose]) -> Pose:
    assert goal.request is pose
    await report(pose)
    return pose


async def outcome_of(function: Any, *args: Any) -> Outcome[Any]:
    return (await run_executor(function, *args)).outcome


# The types


class Row(TypedDict):
    row: int


@attrs.define
class Part:
    name: str


class Place(pydantic.BaseModel):
    x: float


class Up(msgspec.Struct, tag=True):
    meters: int


class Down(msgspec.Struct, tag=True):
    meters: int


async def by_a_dataclass(goal: Way) -> None: ...
async def by_an_attrs_class(goal: Part) -> None: ...
async def by_a_typed_dict(goal: Row) -> None: ...
async def by_a_model(goal: Place) -> None: ...
async def by_one_of_two(goal: Up | Down) -> None: ...


@dataclasses.dataclass
class Way:
    meters: int


@pytest.mark.parametrize(
    ("function", "goal"),
    [
        (by_a_dataclass, Way(1)),
        (by_an_attrs_class, Part("arm")),
        (by_a_typed_dict, Row(row=1)),
        (by_a_model, Place(x=1)),
        (by_one_of_two, Down(1)),
    ],
)
def test_a_single_parameter_that_has_fields_is_the_goal_itself(function: Any, goal: Any) -> None:
    made = action("go")(function)
    assert made.goal.decode(made.goal.encode(goal)) == goal
    assert made.goal_of(goal) is made.goal_of(goal=goal) is goal
    assert made.parameters == {"goal"}


async def of_a_union(goal: Pose | None = None) -> None: ...
async def of_a_list(goal: list[Pose]) -> None: ...
async def of_any(goal: Any) -> None: ...
async def of_models(goal: list[Place], speed: float = 1.0) -> None: ...
async def of_no_model(goal: Place | None = None) -> None: ...


@pytest.mark.parametrize(
    ("function", "payload"),
    [
        (of_a_union, {}),
        (of_a_union, {"goal": {"x": 1.0}}),
        (of_a_list, {"goal": [{"x": 1.0}]}),
        (of_any, {"goal": 3}),
        (of_models, {"goal": [{"x": 1.0}]}),
        (of_no_model, {}),
    ],
)
def test_any_other_parameter_is_a_field_of_the_goal(function: Any, payload: Any) -> None:
    made = action("go")(function)
    goal = made.goal.decode(msgspec.msgpack.encode(payload))
    assert made.goal_of(**made._signature.goal.arguments(goal)) == goal
    schema = made.info.goal
    if "$ref" in schema:
        schema = schema["$defs"][schema["$ref"].rpartition("/")[2]]
    assert schema["properties"].keys() == made.parameters


def test_parameters_are_the_fields_of_the_goal_with_their_defaults_and_descriptions() -> None:
    assert place.info.goal["$defs"]["PlaceGoal"]["properties"] == {
        "what": {"type": "string", "description": "the name of a part"},
        "force": {"type": "number", "default": 1.0},
    }
    goal: Any = pick.goal_of("cup", 2)
    assert repr(goal) == "PickGoal(what='cup', force=2)"
    assert place.goal.decode(b"\x81\xa4what\xa3cup") == place.goal_of("cup", 1.0)
    assert drive.goal.encode(drive.goal_of(3)) == b"\x81\xa6meters\x03"
    assert home.goal.encode(home.goal_of()) == b"\x80"
    assert (drive.feedback.type, drive.result.type) == (int, str)
    assert home.result.type is home.feedback.type is type(None)


def test_the_request_of_a_handle_alone_is_the_goal() -> None:
    made: list[Any] = [look, move]
    assert [one.goal.type for one in made] == [Pose, Pose]
    assert [one.goal_of(Pose(1)) for one in made] == [Pose(1), Pose(1)]


def test_a_report_and_a_handle_may_have_a_text() -> None:
    @action
    async def look(
        report: Annotated[Report[int], "How far."], goal: Annotated[GoalHandle[str], "What."]
    ) -> None: ...

    assert [look.feedback.type, cast("Any", look.goal.type)] == [int, str]


def test_marks_of_msgspec_hold_beside_a_model() -> None:
    class Model(pydantic.BaseModel):
        x: int

    @action
    async def look(
        model: Model, meters: Annotated[int, msgspec.Meta(ge=1, description="How far.")]
    ) -> None: ...

    fields = look.goal.schema()["properties"]
    assert fields["meters"] == {
        "type": "integer",
        "minimum": 1,
        "description": "How far.",
        "title": "Meters",
    }
    with pytest.raises(ProtocolError, match="greater than or equal to 1"):
        look.goal.decode(msgspec.msgpack.encode({"model": {"x": 1}, "meters": 0}))


def test_arguments_that_do_not_fit_are_told_with_the_signature() -> None:
    told = r"^place\(what: .*, force: float = 1.0\): missing a required argument: 'what'$"
    wrong: Any = place
    with pytest.raises(TypeError, match=told):
        wrong.goal_of(force=1)
    with pytest.raises(TypeError, match="got an unexpected keyword argument 'forc'"):
        wrong.goal_of("cup", forc=1)


def test_it_is_named_and_documented_as_its_function() -> None:
    assert (drive.name, drive.__doc__) == ("drive", "Drive some meters.")
    assert getattr(drive, "__name__", "") == "drive"
    assert action("arm/drive")(drive._function).name == "arm/drive"
    assert (drive.info.description, home.info.description) == ("Drive some meters.", "")
    assert move.type_name == "my_robot/action/Move"


def of_no_type(meters) -> None: ...  # type: ignore[no-untyped-def]  # it is rejected for that
def of_a_report_of_no_type(report) -> None: ...  # type: ignore[no-untyped-def]  # as above
def without_a_result(meters: int): ...  # type: ignore[no-untyped-def]  # as above
def of_any_feedback(meters: int, report: Report) -> None: ...  # type: ignore[type-arg]  # as above
def of_two_reports(one: Report[int], two: Report[int]) -> None: ...
def of_two_handles(one: GoalHandle[int], two: GoalHandle[int]) -> None: ...
def of_any_goal(goal: GoalHandle) -> None: ...  # type: ignore[type-arg]  # as above
def of_many(*meters: int) -> None: ...
def of_names(**meters: int) -> None: ...
def of_perhaps_a_report(meters: int, report: Report[int] | None = None) -> None: ...
def of_a_function(meters: int, report: Callable[[int], None]) -> None: ...
def of_what_is_not_defined(meters: Metres) -> None: ...  # type: ignore[name-defined]  # noqa: F821  # pyright: ignore[reportUndefinedVariable]  # as above
def of_a_wrong_default(meters: int = cast("int", "one")) -> None: ...
def of_a_default_of_all(pose: Pose = Pose(1)) -> None: ...  # noqa: B008  # it is rejected for that
def of_a_typo(meters: "int | ") -> None: ...  # type: ignore[valid-type]  # noqa: F722  # as above
def of_a_thread(thread: threading.Thread) -> None: ...
def of_a_field(meters: int = msgspec.field(default=1)) -> None: ...
def of_a_hidden_name(__meters: int) -> None: ...
def of_another_request(goal: GoalHandle[int], meters: int) -> None: ...


class WithClassmethod:
    def make(cls, meters: int) -> None: ...


async def yields(goal: GoalHandle[int]) -> AsyncIterator[int]:
    yield 1


def yields_without_async(goal: GoalHandle[int]) -> Generator[int, None, None]:
    yield 1


class Yields:
    async def __call__(self, goal: GoalHandle[int]) -> AsyncGenerator[int, None]:
        yield 1


@pytest.mark.parametrize(
    ("function", "text"),
    [
        (of_no_type, "has no type for its parameter 'meters': write `meters: int`"),
        (of_a_report_of_no_type, "has no type for `report`: write `report: Report[int]`"),
        (without_a_result, "has no type for what it returns: write `-> str`, or `-> None`"),
        (of_any_feedback, "has no type of feedback for 'report': write `report: Report[int]`"),
        (of_two_reports, "has a Report twice, 'one' and 'two'"),
        (of_two_handles, "has a GoalHandle twice, 'one' and 'two'"),
        (of_any_goal, "has no type for its goal: write `goal: GoalHandle[int]`"),
        (of_many, "takes *meters: 'int', and the fields of a goal have names"),
        (of_names, "takes **meters: 'int', and the fields of a goal have names"),
        (
            of_perhaps_a_report,
            "may be called without 'report': a server always gives it a `Report[",
        ),
        (
            of_a_function,
            "takes a function as 'report', and a goal is data: write `report: Report[int]`",
        ),
        (
            of_what_is_not_defined,
            "has a type that is not defined here: name 'Metres' is not defined",
        ),
        (staticmethod(of_many), "is a staticmethod: write @action below @staticmethod"),
        (classmethod(cast("Any", of_many)), "is a classmethod: an action is a method of an object"),
        (
            of_a_wrong_default,
            "cannot have its parameters as fields of a goal: the default of 'meters', 'one', is",
        ),
        (
            of_a_default_of_all,
            "cannot have its parameters as fields of a goal: 'pose' is the goal itself, and has",
        ),
        (
            of_a_field,
            "cannot have its parameters as fields of a goal: the default of 'meters' is a",
        ),
        (of_a_hidden_name, "has the parameter '__meters', and a field does not begin with two"),
        (
            of_another_request,
            "has its goal in the other parameters, and not in 'goal': write `goal: GoalHandle[obj",
        ),
        (WithClassmethod.make, "is a classmethod: an action is a method of an object"),
        (of_a_typo, "has a type that cannot be read: "),
        (Pose, "is a class: write @action above its methods"),
        (yields, "is a generator function, and @action is for functions that report and return"),
        (yields_without_async, "is a generator function, and @action is for functions"),
        (Yields(), "is a generator function, and @action is for functions"),
    ],
)
def test_a_signature_that_will_not_do_is_told_in_one_sentence(function: Any, text: str) -> None:
    with pytest.raises(TypeError) as caught:
        action("drive")(function)
    name = getattr(function, "__name__", type(function).__name__)
    assert str(caught.value).startswith(f"{name}() {text}")
    assert "\n" not in str(caught.value)


def test_a_type_that_cannot_be_encoded_is_told_as_for_an_action() -> None:
    with pytest.raises(TypeError, match="the goal of action 'drive': Thread cannot be encoded"):
        action("drive")(of_a_thread)


def test_a_name_that_breaks_the_rule_is_told() -> None:
    with pytest.raises(ValueError, match="an action's name is like"):
        action("3 m")(Robot())


def test_only_an_action_of_a_function_has_an_executor_of_its_own() -> None:
    plain = Action("drive", goal=int, feedback=int, result=str)
    with pytest.raises(TypeError, match=r"<Action 'drive'> has no executor: write ActionServer\("):
        ActionServer(plain)
    assert ActionServer(drive, result_timeout=1).action is drive


# The run


async def test_an_executor_iterates_over_the_one_of_a_function() -> None:
    async def twice(goal: GoalHandle[int]) -> AsyncIterator[int | str | Return[str]]:
        yield 0
        async for item in drive.executor(goal):
            yield Return(f"{item.value} in all") if isinstance(item, Return) else item

    trial = await run_executor(drive, twice, drive.goal_of(3))
    assert trial.feedback == [0, 1, 2, 3]
    assert trial.outcome.result == "drove 3 m in all"


async def test_the_arguments_are_the_fields_the_handle_and_the_report() -> None:
    trial = await run_executor(pick, "cup", 0.5)
    assert (trial.feedback, trial.outcome.result) == ([0.5], [0.5, 3])
    assert (await outcome_of(home)).status is GoalStatus.SUCCEEDED
    assert (await outcome_of(look, Pose(1))).result == Pose(2)
    trial_of_move = await run_executor(move, Pose(1))
    assert trial_of_move.feedback == [trial_of_move.outcome.result] == [Pose(1)]


async def test_a_report_may_be_given_by_its_name_only() -> None:
    async def weigh(what: str, /, force: float = 1.0, *, report: Report[float]) -> float:
        await report(force)
        return force

    weighing = FunctionAction[..., float, float, Any]("weigh", weigh)
    trial = await run_executor(weighing, "cup")
    assert (trial.feedback, trial.outcome.result) == ([1.0], 1.0)


class Robot:
    """Functions of other kinds."""

    async def drive(self, meters: int, report: Report[int]) -> int:
        await report(meters)
        return meters

    async def __call__(self, meters: int) -> int:
        return meters + 1


async def test_methods_and_objects_that_can_be_called_are_functions_too() -> None:
    method = action("drive")(Robot().drive)
    trial = await run_executor(method, 3)
    assert (trial.feedback, trial.outcome.result) == ([3], 3)
    assert (await outcome_of(action("drive")(Robot()), 3)).result == 4


async def test_what_a_partial_function_has_been_given_is_no_field_of_the_goal() -> None:
    async def drive(robot: Robot, meters: int, report: Report[int]) -> int:
        return await robot.drive(meters, report)

    robot = Robot()
    by_name, by_place = action(partial(drive, robot=robot)), action("go")(partial(drive, robot))
    assert by_name.name == "drive"
    made: Any
    for made in (by_name, by_place):
        assert (await run_executor(made, meters=3)).outcome.result == 3


async def test_the_types_of_a_function_may_be_those_of_the_block_around_it() -> None:
    class Local(msgspec.Struct):
        x: int

    factor = 2

    @action
    async def scale(where: Local) -> int:
        return where.x * factor

    assert (await outcome_of(scale, Local(2))).result == 4


class Rover:
    """An object whose methods are actions."""

    def __init__(self, speed: float) -> None:
        self.speed = speed

    @action
    async def move(self, report: Report[float], x: float) -> float:
        """Move along the x axis."""
        await report(x)
        return x / self.speed

    @action("rover/grip")
    def grip(self, force: float = 1.0) -> float:
        return force * self.speed

    @staticmethod
    @action
    async def halt() -> None: ...


async def test_the_action_of_a_method_runs_with_the_object_that_it_is_an_attribute_of() -> None:
    slow, fast = Rover(1), Rover(10)
    assert Rover.move.info == slow.move.info
    assert (Rover.move.name, Rover.move.__doc__) == ("move", "Move along the x axis.")
    assert Rover.grip.parameters == {"force"}
    for rover, took in ((slow, 5.0), (fast, 0.5)):
        trial = await run_executor(rover.move, 5.0)
        assert (trial.feedback, trial.outcome.result) == ([5.0], took)
        assert await rover.move(5.0) == await Rover.move(rover, 5.0) == took
    assert (await outcome_of(fast.grip)).result == 10.0
    assert [one.name for one in actions_of(slow)] == ["move", "rover/grip", "halt"]


def test_a_method_cannot_be_served_without_its_object() -> None:
    told = (
        r"^<Action 'move'> is a method, .*: serve the action of one, as in `serve\(Robot\(\).move"
    )
    with pytest.raises(TypeError, match=told):
        ActionServer(Rover.move)


# Feedback and result of one type


async def test_a_mark_that_is_missing_is_told_with_what_to_write() -> None:
    async def forgets(goal: GoalHandle[int]) -> AsyncIterator[int]:
        yield 1

    outcome = (
        await run_executor(Action("count", goal=int, feedback=int, result=int), forgets, 3)
    ).outcome
    assert outcome.reason == (
        "the executor is wrong: it ended without yielding a result; its feedback and its result"
        " have one type, so mark the result: `Return(...)`"
    )


# Called as functions


async def test_it_is_called_as_the_function_that_it_was() -> None:
    found: list[int] = []
    assert await drive(3, report=found.append) == "drove 3 m"
    assert found == [1, 2, 3]
    assert await drive(2) == "drove 2 m"
    assert await drive(found.append, 1) == "drove 1 m"
    assert found[3:] == [1]
    assert await place("cup") == [1.0, 3]
    for options in ({"report": print}, {}):
        with pytest.raises(TypeError, match="missing a required argument: 'meters'"):
            await drive(**options)
    assert await pick("cup", 2.0) == [2.0, 3]


async def test_its_report_may_be_an_async_function_or_a_report() -> None:
    found: list[int] = []

    async def note(number: int) -> None:
        await anyio.lowlevel.checkpoint()
        found.append(number)

    @action("twice")
    async def twice(meters: int, report: Report[int]) -> str:
        return await drive(report, meters) + await drive(meters, report=note)

    trial = await run_executor(twice, 2)
    assert trial.feedback == found == [1, 2]


# Threads


async def test_a_plain_function_runs_in_a_thread_that_knows_its_goal() -> None:
    @action("where")
    def where(goal: GoalHandle[int]) -> list[int]:
        goal.check()
        return [threading.get_ident(), goal.request]

    (thread, request) = (await outcome_of(where, 3)).result or []
    assert thread != threading.get_ident()
    assert request == 3


async def test_a_cancel_arrives_at_the_next_check() -> None:
    go = threading.Event()

    @action("wait")
    def wait(goal: GoalHandle[None]) -> str:
        go.wait()
        try:
            goal.check()
        except GoalCanceled:
            goal.check()  # it came once
            raise GoalCanceled("stopped", result="a part") from None
        return "not canceled"

    async with ActionServer(wait) as server:
        async with ActionClient(server, wait).send_goal() as goal:
            await anyio.wait_all_tasks_blocked()
            assert (await goal.cancel()).accepted
            go.set()
            assert await goal.outcome() == End(GoalStatus.CANCELED, "a part", "stopped")


async def test_a_server_that_stops_raises_in_its_threads(anyio_backend: Any) -> None:
    seen: list[str] = []

    @action("spin")
    def spin(report: Report[int]) -> None:
        try:
            while True:
                report(1)
        except GoalCanceled:
            seen.append("canceled")
            raise

    async with ActionServer(spin, feedback="latest") as server:
        async with ActionClient(server, spin).send_goal() as goal:
            async for _ in goal.feedback:
                break
            await server.stop()
            outcome = await goal.outcome()
    assert outcome == End(GoalStatus.ABORTED, None, "server stopped")
    assert seen == ["canceled"]


async def test_a_thread_that_was_abandoned_is_canceled_at_each_report() -> None:
    reported, go, gone = threading.Event(), threading.Event(), threading.Event()
    seen: list[str] = []

    @action("stuck")
    def stuck(goal: GoalHandle[None], report: Report[int]) -> None:
        report(1)
        reported.set()
        go.wait()
        for act in (goal.check, lambda: report(2), lambda: report(3)):
            try:
                act()
            except GoalCanceled:
                seen.append("canceled")
        gone.set()

    async with ActionServer(stuck, shutdown_timeout=0) as server:
        async with ActionClient(server, stuck).send_goal() as goal:
            async for _ in goal.feedback:
                break
            assert await anyio.to_thread.run_sync(reported.wait, 5)
            await server.stop()
            assert (await goal.outcome()).reason == "server stopped"
    go.set()
    assert await anyio.to_thread.run_sync(gone.wait, 5)
    assert seen == ["canceled"] * 3


async def test_no_more_goals_than_the_most_run_in_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(function_action, "MOST_THREADS", 1)
    running: list[int] = []
    most = 0

    @action("count")
    def count(number: int) -> int:
        nonlocal most
        running.append(number)
        most = max(most, len(running))
        running.remove(number)
        return number

    async with ActionServer(count) as server:
        client = ActionClient(server, count)
        goals = [await client.send_goal(number) for number in range(5)]
        assert [await goal.result() for goal in goals] == [*range(5)]
    assert most == 1


@action("backup")
async def backup(report: Report[Path], source: Path, into: Path = Path("/backup")) -> Path:
    await report(source)
    return into / source.name


async def test_a_function_takes_and_returns_paths() -> None:
    seen: list[Path] = []
    async with ActionServer(backup) as server:
        client = ActionClient(server, backup)
        assert await client.call(Path("a/b"), on_feedback=seen.append) == Path("/backup/b")
    assert seen == [Path("a/b")]
    path = {"type": "string", "format": "path"}
    properties = backup.info.goal["$defs"]["BackupGoal"]["properties"]
    assert properties == {"source": path, "into": {**path, "default": "/backup"}}


# What strangers do


async def test_a_default_that_can_be_changed_is_one_of_each_goal() -> None:
    @action
    async def collect(n: int, way: list[int] = [0], more: list[int] = []) -> list[int]:  # noqa: B006  # that is shown
        way.append(n)
        return way + more

    @action
    async def with_a_model(n: int, place: Place = Place(x=1), way: list[int] = [0]) -> float:  # noqa: B006, B008  # as above
        way.append(n)
        place.x += len(way)
        return place.x

    for _ in range(2):
        assert (await outcome_of(collect, 1)).result == [0, 1]
        assert (await outcome_of(with_a_model, 1)).result == 3.0


def test_an_attribute_of_the_function_is_none_of_its_action() -> None:
    async def drive(meters: int) -> None: ...

    marked: Any = drive
    marked.name, marked.run, marked.goal = "other", 3, (1, 2)
    made = action(drive)
    assert (made.name, callable(made.run), *made.parameters) == ("drive", True, "meters")


async def test_a_wrapper_of_an_async_function_is_awaited() -> None:
    def logged(function: Any) -> Any:
        @functools.wraps(function)
        def inner(*args: Any, **kwargs: Any) -> Any:
            return function(*args, **kwargs)

        return inner

    made = action(logged(drive._function))
    assert (await run_executor(made, meters=2)).outcome.result == "drove 2 m"


def test_a_method_without_the_decorator_does_not_hide_an_action() -> None:
    class Hidden(Rover):
        async def move(self, report: Report[float], x: float) -> float:  # type: ignore[override]  # that is shown
            return x

    with pytest.raises(
        TypeError, match=r"^Hidden\.move takes the place of the action Rover\.move: "
    ):
        actions_of(Hidden(1))


def test_the_types_of_a_method_may_be_those_around_its_class() -> None:
    class Local(msgspec.Struct):
        x: int

    class Inner:
        @action
        async def move(self: Inner, to: Local) -> None: ...

    made: Any = Inner.move
    assert made.goal.type is Local
    assert [*inspect.signature(Inner().move).parameters] == ["to"]
