"""The configuration of a session of Zenoh: the default of `rmw_zenoh_cpp`, its variables of the
environment, and the settings of a URL.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Final

import zenoh
from msgspec import Struct

from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.words.errors import TransportError, text_of
from fibaction_transports.ros2.node.middlewares import ROUTER_PORT

ATTEMPTS: Final = "ZENOH_ROUTER_CHECK_ATTEMPTS"
"""The variable with the number of times that a router is looked for before the start: 0 is without
an end, and less than 0 is not at all."""
FILE: Final = "ZENOH_SESSION_CONFIG_URI"
"""The variable with the path of a file, which replaces the default as a whole."""
OVERRIDE: Final = "ZENOH_CONFIG_OVERRIDE"
"""The variable with `key=json5;key=json5`, which is applied after the file."""
QUERIES_TIMEOUT: Final = 600.0
"""Seconds for which a request waits for its answer at most, as in ROS."""

_DEFAULT = {
    "mode": "peer",
    "listen/endpoints": ["tcp/localhost:0"],
    "connect/endpoints": [f"tcp/localhost:{ROUTER_PORT}"],
    "connect/timeout_ms": {"router": -1, "peer": -1, "client": 0},
    "connect/exit_on_failure": {"router": False, "peer": False, "client": True},
    "open/return_conditions/connect_scouted": False,
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
    "scouting/gossip/autoconnect_strategy": {
        "peer": {"to_router": "always", "to_peer": "greater-zid"}
    },
    "queries_default_timeout": int(QUERIES_TIMEOUT * 1000),
    "transport/shared_memory/enabled": False,
    "transport/link/rx/max_message_size": 268_435_456,
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,
}
"""The default of `rmw_zenoh_cpp`, with three exceptions. There the lease is 60 s, a session waits
half a second until peers connect, and a message may have 1 GiB.
"""
LEASES: Final = 5
"""Leases of a node after which others miss it if its machine has vanished. It takes longer than
over DDS, since they do not wait until it is back.
"""

logger = clean_logger("fibaction.ros2")


class Configuration(Struct, frozen=True, kw_only=True):
    """The configuration of a session, by the settings and the environment."""

    mode: str
    """`peer` or `client`; empty if the file or the default says it."""
    locators: Sequence[str]
    """The routers or peers to connect to; none if the file or the default says them."""
    environ: Mapping[str, str]
    lease: float = 2.0
    """The lease of the node, in seconds."""
    values: str = ""
    """Values that count before all others, as in `ZENOH_CONFIG_OVERRIDE`."""

    @property
    def key(self) -> tuple[str, ...]:
        """The part that configurations have in common whose nodes can share a session."""
        variables = (self.environ.get(one, "") for one in (FILE, OVERRIDE))
        return (self.mode, *self.locators, self.values, str(self.lease), *variables)

    @property
    def attempts(self) -> float | None:
        """The number of looks for a router before the start; None if that is not asked."""
        try:
            return int(self.environ.get(ATTEMPTS, "")) or math.inf
        except ValueError:
            return None

    def made(self) -> zenoh.Config:
        """Return it as the library has it.

        Raises:
            TransportError: The file cannot be read, or a value is not valid.
        """
        config = self._base()
        for key, value in _pairs(self.environ.get(OVERRIDE, "")):
            try:
                config.insert_json5(key, value)
            except zenoh.ZError:
                logger.warning("%s: %s=%s is not valid, and ignored", OVERRIDE, key, excerpt(value))
        given: dict[str, object] = {"timestamping/enabled": True}  # latched topics need it
        if self.locators:
            given["connect/endpoints"] = list(self.locators)
        if self.mode:
            given["mode"] = self.mode
        _insert(config, given)
        for key, value in _pairs(self.values):
            try:
                config.insert_json5(key, value)
            except zenoh.ZError as exc:
                raise TransportError(
                    f"config: {key}={excerpt(value)} is not valid in Zenoh: {text_of(exc)}"
                ) from exc
        if json.loads(config.get_json("mode") or "null") == "client":
            _insert(config, {"listen/endpoints": []})
        return config

    def _base(self) -> zenoh.Config:
        if path := self.environ.get(FILE):
            try:
                return zenoh.Config.from_file(path)
            except zenoh.ZError as exc:
                raise TransportError(f"{FILE}={excerpt(path)}: {text_of(exc)}") from exc
        config = zenoh.Config()
        milliseconds = int(LEASES * self.lease * 1000)
        _insert(config, {**_DEFAULT, "transport/link/tx/lease": milliseconds})
        return config

    def advice(self, error: Exception) -> str:
        """Return what to do when a session cannot be opened."""
        reason = str(error).partition(" at /")[0].strip(" !")  # without the place in its source
        return (
            f"{reason}; is a router there? `ros2 run rmw_zenoh_cpp rmw_zenohd` starts one, or"
            " without ROS `fibaction router`, and mode=peer needs none"
        )


def _pairs(text: str) -> list[tuple[str, str]]:
    parts = (one.partition("=") for one in text.split(";") if one)
    return [(key.strip(), value.strip()) for key, _, value in parts]


def _insert(config: zenoh.Config, values: Mapping[str, object]) -> None:
    for key, value in values.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as exc:
            raise TransportError(f"{key}={value!r} is not valid in Zenoh: {text_of(exc)}") from exc
