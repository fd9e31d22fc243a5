"""Message envelope: a trailer with sequence number, publisher and source timestamp after the message's bytes.

A CDR reader stops at the end of its type, so nodes that don't know the envelope read the message unchanged
(verified with Fast DDS and cyclonedds).
"""

from __future__ import annotations

import struct
from typing import NamedTuple

MAGIC = b"scan2sim"
TRAILER = struct.Struct("<QQ16sq8s")
"""Size of the message in bytes, its number, GID of the publisher, nanoseconds since the epoch, magic number."""
ALIGNMENT = 4
"""DDS pads messages to a multiple of this number of bytes."""


class Header(NamedTuple):
    """Metadata of a message; a tuple because one is created per message.

    Attributes:
        number: sequence number of the publisher, increasing by one.
        publisher: GID of the publisher.
        sent: source timestamp, nanoseconds since the epoch by the sender's clock.
    """

    number: int
    publisher: bytes
    sent: int


def wrap(data: bytes | memoryview, number: int, publisher: bytes, sent: int) -> bytes:
    """Append the envelope to the bytes of a message."""
    return b"".join((data, bytes(-len(data) % ALIGNMENT), TRAILER.pack(len(data), number, publisher, sent, MAGIC)))


def unwrap(data: bytes) -> tuple[memoryview, Header | None]:
    """Split into the message's own bytes and the content of the envelope; None if there is no envelope."""
    if not data.endswith(MAGIC) or len(data) < TRAILER.size:
        return memoryview(data), None
    size, number, publisher, sent, _ = TRAILER.unpack_from(data, len(data) - TRAILER.size)
    return memoryview(data)[:size], Header(number, publisher, sent)
