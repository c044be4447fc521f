"""The middleware that nodes of ROS use here, as far as the environment says it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

RMW: Final = "RMW_IMPLEMENTATION"
"""The variable by which ROS chooses its middleware."""
RMW_ZENOH: Final = "rmw_zenoh_cpp"


def is_zenoh_named(environ: Mapping[str, str]) -> bool:
    """Return whether the environment says that nodes of ROS use Zenoh."""
    return environ.get(RMW) == RMW_ZENOH
