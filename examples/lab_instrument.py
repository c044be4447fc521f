"""An instrument in a lab: a spectrometer with one lamp, scripts that share it, and a stop button.

The spectrometer answers lines of text over TCP, as many instruments do. Its driver blocks, so the
action is a plain function, which runs in a thread. One scan runs at a time, and others wait in
turn. However a scan ends, the lamp is off, and a scan that was stopped returns what it has.

The instrument, the server and the two scripts are one program here. In a lab, the server runs on
the machine beside the instrument, and each script is a program of its own.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from socketserver import StreamRequestHandler, ThreadingTCPServer

from msgspec import Struct

from fibaction import ActionServer, GoalCanceled, Report, Schedule, action
from fibaction.blocking import connect, serve

# The instrument, as its maker has made it


class Spectrometer(StreamRequestHandler):
    """A connection to the instrument: a command in each line, an answer to each `?`."""

    lamp = "OFF"

    def handle(self) -> None:
        """Answer each line."""
        for line in self.rfile:
            command, _, value = line.decode().strip().partition(" ")
            if command == "LAMP":
                Spectrometer.lamp = value
            elif command == "LAMP?":
                self.wfile.write(f"{Spectrometer.lamp}\n".encode())
            elif command == "READ?":
                time.sleep(0.01)  # this thread is the instrument's
                self.wfile.write(f"{1 - abs(int(value) - 550) / 1000:.3f}\n".encode())


@contextmanager
def instrument() -> Generator[tuple[str, int], None, None]:
    """Switch the instrument on, and yield its address."""
    with ThreadingTCPServer(("127.0.0.1", 0), Spectrometer) as server:
        threading.Thread(target=server.serve_forever).start()
        try:
            yield "127.0.0.1", int(server.server_address[1])
        finally:
            server.shutdown()


# The server beside it


class Reading(Struct):
    """The light that came through, from 0 to 1, at a wavelength."""

    wavelength: int
    light: float


class Driver:
    """The driver of the instrument. It blocks until the instrument has answered."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._socket = socket.create_connection(address, timeout=10)
        self._lines = self._socket.makefile("rw")

    def close(self) -> None:
        """Leave the instrument."""
        self._lines.close()
        self._socket.close()

    def tell(self, command: str) -> None:
        """Send a command."""
        self._lines.write(f"{command}\n")
        self._lines.flush()

    def ask(self, command: str) -> str:
        """Send a command, and return the answer."""
        self.tell(command)
        return self._lines.readline().strip()

    @action
    def scan(self, report: Report[Reading], first: int, last: int) -> list[Reading]:
        """Read at each wavelength, in nanometers, with the lamp on."""
        readings: list[Reading] = []
        self.tell("LAMP ON")
        try:
            for wavelength in range(first, last + 1):
                readings.append(Reading(wavelength, float(self.ask(f"READ? {wavelength}"))))
                report(readings[-1])  # here a cancel arrives
        except GoalCanceled:
            raise GoalCanceled(result=readings) from None
        finally:
            self.tell("LAMP OFF")
        return readings


# The scripts


def run_scripts(url: str) -> None:
    """Order a long scan and a short one, and stop the long one."""
    with (
        connect(url, Driver.scan) as mine,
        connect(url, Driver.scan) as yours,
        mine.send_goal(400, 2400) as long,
        yours.send_goal(540, 560) as short,
    ):
        for reading in long.feedback:
            print(f"long: {reading.light} at {reading.wavelength} nm")
            if reading.wavelength >= 402:
                print(f"short: {short.status.name}, it waits")
                long.cancel()
                break
        stopped = long.outcome()
        assert stopped.result is not None
        print("long:", stopped.status.name, "with the first", stopped.result[0])
        brightest = max(short.result(), key=lambda reading: reading.light)
        print(f"short: brightest at {brightest.wavelength} nm")


def main() -> None:
    """Switch all on, run the scripts, and look at the lamp."""
    with instrument() as address:
        driver = Driver(address)
        try:
            server = ActionServer(driver.scan, schedule=Schedule(concurrency=1, queue=8))
            with serve(server, "tcp://127.0.0.1:0") as (url,):
                run_scripts(url)
            print("lamp:", driver.ask("LAMP?"))
        finally:
            driver.close()


if __name__ == "__main__":
    main()
