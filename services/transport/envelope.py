"""A message and what is to be known of it: number, publisher and time of sending, behind its own bytes.

A reader of CDR stops where its type ends, so nodes that know nothing of the envelope read what it wraps
(tried: Fast DDS and cyclonedds).
"""

from __future__ import annotations

import struct
from typing import NamedTuple

MARK = b"scan2sim"
BEHIND = struct.Struct("<QQ16sq8s")
"""Bytes of the message, its number, GID of the publisher, nanoseconds since the epoch, mark."""
ALIGNED = 4
"""DDS pads messages to as many bytes."""


class Header(NamedTuple):
    """What is known of a message; one is made for each, so it is a tuple, which costs least.

    Attributes:
        number: one more than that of the publisher's last message.
        publisher: its GID.
        sent: nanoseconds since the epoch, by the sender's clock.
    """

    number: int
    publisher: bytes
    sent: int


def wrapped(data: bytes | memoryview, number: int, publisher: bytes, sent: int) -> bytes:
    """A message's bytes with the envelope behind them."""
    return b"".join((data, bytes(-len(data) % ALIGNED), BEHIND.pack(len(data), number, publisher, sent, MARK)))


def opened(data: bytes) -> tuple[memoryview, Header | None]:
    """The message's own bytes, and what the envelope says; None: there is none."""
    if not data.endswith(MARK) or len(data) < BEHIND.size:
        return memoryview(data), None
    size, number, publisher, sent, _ = BEHIND.unpack_from(data, len(data) - BEHIND.size)
    return memoryview(data)[:size], Header(number, publisher, sent)
