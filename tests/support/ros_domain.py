"""Domains of ROS, one for each test run of this machine."""

from __future__ import annotations

import socket

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
