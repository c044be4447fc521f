"""Processes with the robot, for tests in a browser."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from typing import Self

from tests.support.ports import free_port
from tests.support.processes import PATIENCE

ROOT = Path(__file__).resolve().parents[2]


class RobotProcess:
    """A process that serves the robot at one address; it can be killed, and started again."""

    def __init__(self, query: str = "", token: str = "") -> None:
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        """The address of the page, without a slash at its end."""
        self.token = token
        self._query = query
        self._process: subprocess.Popen[str] | None = None

    @property
    def pid(self) -> int:
        """The ID of the process."""
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Start the process, and wait until it serves."""
        command = [sys.executable, "-m", *self.program()]
        self._process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        line = self._process.stdout.readline().strip()
        if not line:
            self.kill()
            raise RuntimeError("the robot has not started")
        self.take(line)

    def take(self, line: str) -> None:
        """Take the line that the process has printed, for a process whose line says more."""

    def program(self) -> list[str]:
        """Return the module to run, and its arguments."""
        return ["tests.browser.robot", self.url + self._query, *filter(None, [self.token])]

    def kill(self) -> None:
        """End the process at once, as a power failure does."""
        self.end(signal.SIGKILL)

    def end(self, number: signal.Signals) -> None:
        """End the process with a signal."""
        if self._process is not None:
            self._process.send_signal(number)
            self._process.wait(PATIENCE)
            assert self._process.stdout is not None
            self._process.stdout.close()
            self._process = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class BridgeProcess(RobotProcess):
    """A process that serves the actions of a robot at another address."""

    def __init__(self, robot: RobotProcess, name: str = "") -> None:
        super().__init__()
        self._from = f"{name}={robot.url}" if name else robot.url

    def program(self) -> list[str]:
        """Return the module to run, and its arguments."""
        return ["fibaction", "bridge", self._from, self.url]


class ArchiveProcess(RobotProcess):
    """A process whose server has goals in its history that it remembers no more."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._file = folder / "goals.db"

    def program(self) -> list[str]:
        """Return the module to run, and its arguments."""
        return ["tests.browser.archive", self.url, str(self._file)]


class WorkerProcess(RobotProcess):
    """A process that serves the robot as a worker of a fleet."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self.url = url


class RosRobotProcess(RobotProcess):
    """A process of a robot with topics over DDS."""

    def program(self) -> list[str]:
        """Return the module to run, and its arguments."""
        return ["tests.browser.ros_robot", self.url]


class ConsoleProcess(RobotProcess):
    """A process of `fibaction console` with a recording, or with servers."""

    def __init__(self, *sources: object) -> None:
        super().__init__()
        self._sources = [str(source) for source in sources]
        self.address = ""
        """The address of the page, with its token."""

    def program(self) -> list[str]:
        """Return the module to run, and its arguments."""
        return ["fibaction", "console", *self._sources, "--no-open", "--port", str(self.port)]

    def take(self, line: str) -> None:
        """Take the address from the line that the process has printed."""
        self.address = line.split(" at ")[1].split(" , ")[0]
