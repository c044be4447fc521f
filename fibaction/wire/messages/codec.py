"""The bytes of messages: how they are encoded, and decoded at each end."""

from __future__ import annotations

from typing import get_args

import msgspec

from fibaction._runtime.text import excerpt
from fibaction.wire.messages.fields import Ping
from fibaction.wire.messages.from_client import FromClient
from fibaction.wire.messages.from_server import FromServer
from fibaction.words.errors import ProtocolError
from fibaction.words.goals import GoalID


def _plain(value: object) -> bytes:
    if isinstance(value, GoalID):
        return bytes(value)
    raise TypeError(f"a message cannot contain a {type(value).__name__}")


encode = msgspec.msgpack.Encoder(enc_hook=_plain).encode
"""Encode a message as bytes."""

_from_client: msgspec.msgpack.Decoder[FromClient] = msgspec.msgpack.Decoder(FromClient)
_from_server: msgspec.msgpack.Decoder[FromServer] = msgspec.msgpack.Decoder(FromServer)


NEWEST_TAG = max(kind.__struct_config__.tag for kind in get_args(FromServer))
"""The highest tag of the messages that a server of this version sends."""
NEWEST_FROM_CLIENT = max(kind.__struct_config__.tag for kind in get_args(FromClient))
"""The highest tag of the messages that a client of this version sends."""


def _tag_of(frame: bytes) -> int:
    """Return the tag of a message; -1 if the frame is none."""
    try:
        head, *_ = msgspec.msgpack.decode(frame, type=list[msgspec.Raw])
        return msgspec.msgpack.decode(head, type=int)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return -1


def decode_from_client(frame: bytes) -> FromClient:
    """Decode a message that a client sent.

    Raises:
        ProtocolError: The frame is not a valid message of a client.
    """
    try:
        return _from_client.decode(frame)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as exc:
        text = excerpt(str(exc))
    # Raised here, so that it does not keep the error above, which may hold the whole frame.
    raise ProtocolError(f"invalid client message: {text}")


def decode_from_server(frame: bytes) -> FromServer:
    """Decode a message that a server sent; one of a newer kind counts as a sign of life, `Ping`.

    Raises:
        ProtocolError: The frame is not a valid message of a server.
    """
    try:
        return _from_server.decode(frame)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as exc:
        text = excerpt(str(exc))
    if _tag_of(frame) > NEWEST_TAG:
        return Ping()
    raise ProtocolError(f"invalid server message: {text}")
