"""The configuration of a session of Zenoh: the default of `rmw_zenoh_cpp`, its variables of the
environment, and the settings of a URL.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Final

import zenoh
from msgspec import Struct

from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.words.errors import TransportError, text_of
from fibaction_transports.ros2.node.middlewares import ROUTER_PORT

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
    "transport/link/tx/lease": 10_000,
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,
}
"""The default of `rmw_zenoh_cpp`, with two exceptions. The lease is 60 s there: others learn within
this time that this machine has vanished. And there a session waits half a second for peers to
connect.
"""

logger = clean_logger("fibaction.ros2")


class Configuration(Struct, frozen=True, kw_only=True):
    """The configuration of a session, by the settings and the environment."""

    mode: str
    """`peer` or `client`; empty if the file or the default says it."""
    locators: Sequence[str]
    """The routers or peers to connect to; none if the file or the default says them."""
    environ: Mapping[str, str]

    def made(self) -> zenoh.Config:
        """Return it as the library has it.

        Raises:
            TransportError: The file cannot be read, or a value is not valid.
        """
        config = self._base()
        for key, value in self._overrides():
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
        _insert(config, _DEFAULT)
        return config

    def _overrides(self) -> list[tuple[str, str]]:
        parts = (one.partition("=") for one in self.environ.get(OVERRIDE, "").split(";") if one)
        return [(key.strip(), value.strip()) for key, _, value in parts]

    def advice(self, error: Exception) -> str:
        """Return what to do when a session cannot be opened."""
        return (
            f"{text_of(error)}; is a router there? `ros2 run rmw_zenoh_cpp rmw_zenohd` starts"
            " one, and mode=peer needs none"
        )


def _insert(config: zenoh.Config, values: Mapping[str, object]) -> None:
    for key, value in values.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as exc:
            raise TransportError(f"{key}={value!r} is not valid in Zenoh: {text_of(exc)}") from exc
