"""RTP packets of video frames (RFC 3550): VP8 payload by RFC 7741, capture time in a header extension (RFC 8285).

All packets have the same layout, so that one call packs or unpacks the header: 32 bytes, then a part of the frame.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from scan2sim.services.teleoperation.control.messages import Malformed

HEADER = struct.Struct(">BBHII HHBqBH BBH")
"""RTP header (12 bytes), header extension with capture time and encoding delay (16), VP8 payload descriptor (4)."""
PAYLOAD_MAX_BYTES = 1150
"""Maximum payload: with headers, SRTP, UDP and IP below 1280 bytes, the minimum MTU of IPv6."""
_VERSION, _TYPE, _LAST = 0x90, 96, 0x80
_PROFILE, _EXTENSION_WORDS, _CAPTURE_ID, _DELAY_ID = 0xBEDE, 3, 0x17, 0x21
_DELAY_UNIT_NS = 100_000
_FIRST, _CONTINUATION, _NUMBERED, _LONG = 0x90, 0x80, 0x80, 0x8000


class Packet(NamedTuple):
    """A part of a frame.

    Attributes:
        sequence: packet number within its source, 16 bits.
        source: SSRC.
        captured: capture time, nanoseconds of the sender's monotonic clock.
        number: picture number, 15 bits.
        first, last: whether it is the first or last packet of the frame.
        sent: time when it was created, after encoding, nanoseconds of the same clock, in steps of 0.1 ms.
    """

    sequence: int
    source: int
    captured: int
    number: int
    first: bool
    last: bool
    data: bytes
    sent: int = 0

    @property
    def key(self) -> bool:
        """Whether it is the first packet of a key frame (RFC 6386, 9.1)."""
        return self.first and not self.data[0] & 1


def packetize(data: bytes, source: int, sequence: int, number: int, captured: int, sent: int) -> list[bytes]:
    """Split a frame into packets; `sequence` is that of the first one; `sent`: the current time, see `Packet`."""
    delay = min(max(sent - captured, 0) // _DELAY_UNIT_NS, 0xFFFF)
    stamp = captured * 9 // 100_000 & 0xFFFFFFFF
    count = -(-len(data) // PAYLOAD_MAX_BYTES)
    made = []
    for i in range(count):
        header = HEADER.pack(
            _VERSION, _TYPE | _LAST * (i == count - 1), sequence + i & 0xFFFF, stamp, source,
            _PROFILE, _EXTENSION_WORDS, _CAPTURE_ID, captured, _DELAY_ID, delay,
            _CONTINUATION if i else _FIRST, _NUMBERED, _LONG | number & 0x7FFF,
        )  # fmt: skip
        made.append(header + data[i * PAYLOAD_MAX_BYTES : (i + 1) * PAYLOAD_MAX_BYTES])
    return made


def parse(packet: bytes) -> Packet:
    """Parse a packet created by `packetize`.

    Raises:
        Malformed: it is not such a packet.
    """
    try:
        (
            version, kind, sequence, _, source, profile, extension_words, capture, captured, later, delay,
            first, numbered, number,
        ) = HEADER.unpack_from(packet)  # fmt: skip
    except struct.error as error:
        raise Malformed(str(error)) from None
    fixed = (version, kind & 0x7F, profile, extension_words, capture, later, numbered)
    if fixed != (_VERSION, _TYPE, _PROFILE, _EXTENSION_WORDS, _CAPTURE_ID, _DELAY_ID, _NUMBERED):
        raise Malformed("not a video packet")
    if first not in (_FIRST, _CONTINUATION) or not number & _LONG or len(packet) == HEADER.size:
        raise Malformed("not a VP8 packet")
    return Packet(
        sequence,
        source,
        captured,
        number & 0x7FFF,
        first == _FIRST,
        bool(kind & _LAST),
        packet[HEADER.size :],
        captured + delay * _DELAY_UNIT_NS,
    )


def key_frame_size(key_frame: bytes) -> tuple[int, int]:
    """Width and height in the header of a key frame (RFC 6386, 9.1).

    Raises:
        Malformed: it is not a key frame.
    """
    if len(key_frame) < 10 or key_frame[0] & 1 or key_frame[3:6] != b"\x9d\x01\x2a":
        raise Malformed("not a key frame")
    width, height = struct.unpack_from("<HH", key_frame, 6)
    return width & 0x3FFF, height & 0x3FFF
