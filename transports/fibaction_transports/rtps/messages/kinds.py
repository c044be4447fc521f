"""The numbers of the submessages, their flags, and the layouts of their fixed parts."""

from __future__ import annotations

from fibaction_transports.rtps.messages.layout import Layout

MAGIC = b"RTPS"
VERSION = b"\x02\x03"
PACKET_HEAD = 20
"""Size of the head of a packet: magic, version, vendor and prefix."""
SUBMESSAGE_HEAD = Layout("BBH")

PAD = 0x01
ACK_NACK = 0x06
HEARTBEAT = 0x07
GAP = 0x08
INFO_TS = 0x09
INFO_SRC = 0x0C
INFO_DST = 0x0E
INFO_REPLY = 0x0F
NACK_FRAG = 0x12
HEARTBEAT_FRAG = 0x13
DATA = 0x15
DATA_FRAG = 0x16

LITTLE_FLAG = 0x01
FINAL_FLAG = 0x02
ALIVE_FLAG = 0x04
INLINE_FLAG = 0x02
PAYLOAD_FLAG = 0x04
KEY_FLAG = 0x08
FRAGMENT_KEY_FLAG = 0x04
INVALID_FLAG = 0x02
MULTICAST_FLAG = 0x02

DATA_HEAD = Layout("HH4s4siI")
FRAGMENT_HEAD = Layout("HH4s4siIIHHI")
TO_INLINE = 4
"""Bytes before the place from which the distance to the inline QoS counts."""
HEARTBEAT_BODY = Layout("4s4siIiIi")
HEARTBEAT_FRAG_BODY = Layout("4s4siIIi")
ACK_NACK_HEAD = Layout("4s4siI")
NACK_FRAG_HEAD = Layout("4s4siII")
GAP_HEAD = Layout("4s4siIiI")
SOURCE_BODY = Layout("4x2s2s12s")
TIME_BODY = Layout("II")
COUNT = Layout("i")
