"""Domains of ROS, one for each test run of this machine."""

from __future__ import annotations

import fcntl
import os
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fibaction_transports.ros2.node import middlewares
from fibaction_transports.rtps.ports import multicast_port
from tests.support.ports import free_port

DOMAINS = 102
"""The number of domain IDs whose UDP ports are below those that Linux assigns by itself."""
SHARED_MEMORY = Path("/dev/shm")
PORT = re.compile(r"fast(?:dds|rtps)_port(\d+)")


def claim_domain(first: int) -> tuple[int, socket.socket]:
    """Take the first free ROS domain of this machine, looking from `first` on.

    It is taken as long as the socket is open. The kernel closes the socket in any case, and its
    name is not a file, so nothing stays behind.
    """
    for step in range(DOMAINS):
        domain = (first + step) % DOMAINS
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f"\0fibaction-test-ros-domain-{domain}")
        except OSError:
            claim.close()
        else:
            return domain, claim
    raise RuntimeError("all ROS domains of this machine are taken by test runs")


def remove_left_ports(domain: int) -> None:
    """Remove the ports of a domain in shared memory that no process reads any more.

    A port counts who has it open. A process that is killed stays counted, and then the port
    outlives the next processes, too, though they close it.
    """
    numbers = range(multicast_port(domain), multicast_port(domain + 1))  # as those of UDP
    for path in SHARED_MEMORY.glob("fast*_port*"):
        match = PORT.fullmatch(path.name)
        if match and int(match[1]) in numbers and not is_read(path):
            for name in (path.name, f"{path.name}_el", f"sem.{path.name}_mutex"):
                path.with_name(name).unlink(missing_ok=True)


def is_read(port: Path) -> bool:
    """Return whether a process reads a port: it has locked the file beside it."""
    try:
        with port.with_name(f"{port.name}_el").open() as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    return False


@contextmanager
def own_domain() -> Iterator[pytest.MonkeyPatch]:
    """Take a domain that no other test run has, on this machine only; gives the changes of the
    environment, to which more can be added.
    """
    number, claim = claim_domain(os.getpid())
    with claim, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        for name in ("ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "RMW_IMPLEMENTATION"):
            patch.delenv(name, raising=False)
        patch.setattr(middlewares, "LOOKED_AT", free_port())  # nobody listens there
        yield patch
