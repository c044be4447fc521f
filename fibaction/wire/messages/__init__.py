"""Messages of the wire protocol, and their bytes.

Each message is a msgpack array that begins with the tag of its type; `docs/protocol.md` lists all
messages. New fields are added at the end, with a default, and a peer that does not know them
ignores them. A payload is a byte string, encoded by its sender and decoded by its receiver.

Sans-I/O. The rules on which message may follow which are in the session and the client connection.
"""

from __future__ import annotations

from fibaction.wire.messages.codec import NEWEST_FROM_CLIENT as NEWEST_FROM_CLIENT
from fibaction.wire.messages.codec import NEWEST_TAG as NEWEST_TAG
from fibaction.wire.messages.codec import decode_from_client as decode_from_client
from fibaction.wire.messages.codec import decode_from_server as decode_from_server
from fibaction.wire.messages.codec import encode as encode
from fibaction.wire.messages.fields import *  # noqa: F403  # every message is a name of this package
from fibaction.wire.messages.from_client import *  # noqa: F403  # as above
from fibaction.wire.messages.from_server import *  # noqa: F403  # as above
