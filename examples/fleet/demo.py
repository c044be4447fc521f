"""A whole fleet in one terminal: a broker, four robots, and a client. Two robots do not live long.

    pip install 'fibaction[nats,broker,cli]'
    python demo.py

One robot is killed while it picks orders. They go on with other robots when its lease has ended,
here after 2 s. Another one is stopped in good order, and hands its orders over at once.

Exit codes: 0 all orders were picked, 1 one was not, or a part of the fleet did not start.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGTERM, raise_signal, signal
from tempfile import TemporaryDirectory

HERE = Path(__file__).parent
COMMAND = str(Path(sys.executable).with_name("fibaction"))
ROBOTS = ("robot1", "robot2", "robot3", "robot4")
LEASE = 2
PERIOD = 0.4
"""Seconds per item: slow enough to be read."""
ORDERS = 8  # two for each robot
STOP_TIMEOUT = 10.0


@contextmanager
def running(*command: str) -> Iterator[subprocess.Popen[str]]:
    """Run a program for the duration of the block, and stop it at its end."""
    # In its own session, it does not get Ctrl-C; this process stops it in good order.
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            yield process
        finally:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(STOP_TIMEOUT)
            process.kill()


def line_of(process: subprocess.Popen[str]) -> str:
    """Return the first line that a program prints.

    Raises:
        RuntimeError: It has ended instead.
    """
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"{process.args!r} did not start")
    return line.rstrip()


def main(period: float) -> int:
    """Run the fleet, and return the exit code.

    Raises:
        RuntimeError: A part of it did not start.
    """
    with ExitStack() as stack:
        folder = stack.enter_context(TemporaryDirectory())
        broker = stack.enter_context(running(COMMAND, "broker", "--port", "0", "--data", folder))
        host = line_of(broker).partition("nats://")[2].partition("/")[0]
        url = f"nats://{host}/warehouse"
        print(f"broker    {url}", flush=True)
        robots = {
            name: stack.enter_context(
                running(
                    sys.executable,
                    str(HERE / "worker.py"),
                    name,
                    "--url",
                    f"{url}?lease={LEASE}",
                    "--period",
                    str(period),
                )
            )
            for name in ROBOTS
        }
        for robot in robots.values():
            print(f"fleet     {line_of(robot)}", flush=True)
        client = stack.enter_context(
            running(sys.executable, str(HERE / "client.py"), "--url", url, "--orders", str(ORDERS))
        )
        return watch(client, robots)


def watch(client: subprocess.Popen[str], robots: dict[str, subprocess.Popen[str]]) -> int:
    """Print what the client prints; kill one robot, and stop another one later."""
    assert client.stdout is not None
    for line in client.stdout:
        print(line, end="", flush=True)
        if "item  3" in line and "robot1" in line and robots["robot1"].poll() is None:
            print("demo      kill -9 robot1", flush=True)
            robots["robot1"].kill()
            robots["robot1"].wait()
        if "item  5" in line and "robot2" in line and robots["robot2"].poll() is None:
            print("demo      stop robot2, which hands its orders over", flush=True)
            robots["robot2"].terminate()
            robots["robot2"].wait()
    return client.wait()


if __name__ == "__main__":
    # As Ctrl-C, they stop the whole fleet.
    for number in (SIGTERM, SIGHUP):
        signal(number, lambda *_: raise_signal(SIGINT))
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--period", type=float, default=PERIOD, help="seconds per item (default: %(default)g)"
    )
    try:
        sys.exit(main(parser.parse_args().period))
    except RuntimeError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(0)
