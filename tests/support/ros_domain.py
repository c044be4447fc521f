"""Domains of ROS, one for each test run of this machine."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

DOMAINS = 102
"""The number of domain IDs whose UDP ports are below those that Linux assigns by itself."""


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


@contextmanager
def own_domain() -> Iterator[pytest.MonkeyPatch]:
    """Take a domain that no other test run has, on this machine only; gives the changes of the
    environment, to which more can be added.
    """
    number, claim = claim_domain(os.getpid())
    with claim, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        for name in ("ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS"):
            patch.delenv(name, raising=False)
        yield patch
