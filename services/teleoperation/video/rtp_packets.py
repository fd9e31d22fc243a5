"""Pictures as RTP packets (RFC 3550): VP8 by RFC 7741, the time of capture as a header extension (RFC 8285).

All packets have one layout, so that one call packs or unpacks a header: 32 bytes, then a part of the picture.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from scan2sim.services.teleoperation.control.messages import Malformed

HEADER = struct.Struct(">BBHII HHBq3x BBH")
"""RTP's 12 bytes, 16 of its extension (the time of capture), 4 of VP8's payload descriptor (the picture's number)."""
LARGEST = 1150
"""Bytes of a picture in a packet: with headers, SRTP, UDP and IP fewer than 1280, which IPv6 carries anywhere."""
CLOCK = 90_000
"""Hz of RTP's times of video."""
_VERSION, _TYPE, _LAST = 0x90, 96, 0x80
_PROFILE, _WORDS, _STAMP = 0xBEDE, 3, 0x17
_FIRST, _PLAIN, _NUMBERED, _LONG = 0x90, 0x80, 0x80, 0x8000


class Packet(NamedTuple):
    """A part of a picture.

    Attributes:
        sequence: of packets of a source, 16 bits.
        source: SSRC.
        captured: nanoseconds of the sender's monotonic clock.
        number: of the picture, 15 bits.
        first, last: whether the picture begins or ends with it.
    """

    sequence: int
    source: int
    captured: int
    number: int
    first: bool
    last: bool
    data: bytes

    @property
    def key(self) -> bool:
        """Whether a key frame begins with it (RFC 6386, 9.1)."""
        return self.first and not self.data[0] & 1


def packets(data: bytes, source: int, sequence: int, number: int, captured: int) -> list[bytes]:
    """A picture's packets; `sequence` is the first one's."""
    stamp = captured * 9 // 100_000 & 0xFFFFFFFF
    count = -(-len(data) // LARGEST)
    made = []
    for i in range(count):
        header = HEADER.pack(
            _VERSION, _TYPE | _LAST * (i == count - 1), sequence + i & 0xFFFF, stamp, source,
            _PROFILE, _WORDS, _STAMP, captured,
            _PLAIN if i else _FIRST, _NUMBERED, _LONG | number & 0x7FFF,
        )  # fmt: skip
        made.append(header + data[i * LARGEST : (i + 1) * LARGEST])
    return made


def parse(packet: bytes) -> Packet:
    """A packet as `packets` makes them.

    Raises:
        Malformed: it is none.
    """
    try:
        version, kind, sequence, _, source, profile, words, stamp, captured, first, numbered, number = (
            HEADER.unpack_from(packet)
        )
    except struct.error as error:
        raise Malformed(str(error)) from None
    fixed = (version, kind & 0x7F, profile, words, stamp, numbered)
    if fixed != (_VERSION, _TYPE, _PROFILE, _WORDS, _STAMP, _NUMBERED):
        raise Malformed("no packet of video")
    if first not in (_FIRST, _PLAIN) or not number & _LONG or len(packet) == HEADER.size:
        raise Malformed("no packet of VP8")
    return Packet(
        sequence, source, captured, number & 0x7FFF, first == _FIRST, bool(kind & _LAST), packet[HEADER.size :]
    )


def size(key_frame: bytes) -> tuple[int, int]:
    """Width and height that a key frame tells (RFC 6386, 9.1).

    Raises:
        Malformed: it is none.
    """
    if len(key_frame) < 10 or key_frame[0] & 1 or key_frame[3:6] != b"\x9d\x01\x2a":
        raise Malformed("no key frame")
    width, height = struct.unpack_from("<HH", key_frame, 6)
    return width & 0x3FFF, height & 0x3FFF
