"""What a network does to packets: numbered datagrams with their times, sent through it beside what else goes there.

`python -m scan2sim.services.qos.probe receive PORT` and `... send HOST PORT RATE SECONDS`; both ends need one clock,
as two namespaces of one machine have. The receiver prints a line of JSON (`Seen`) once it has heard the end.
"""

from __future__ import annotations

import json
import socket
import struct
import sys
import time
import zlib
from dataclasses import asdict, dataclass

import numpy as np

LAYOUT = struct.Struct("!QQI")
"""Number, nanoseconds of sending, checksum of the filling."""
FILLING = bytes(range(64))
END = 2**64 - 1
"""Number of the last ones, which say how many there were in place of a time."""
ENDS = 20
SILENT = 10.0
"""Seconds without a packet after which the receiver gives up."""


@dataclass(frozen=True)
class Seen:
    """What came.

    Attributes:
        sent: packets.
        loss_rate, error_rate: shares of those sent that didn't come, and of those that came with other bytes.
        delay, jitter: ms, means: of the way, and of the difference of two packets' in a row (RFC 3393).
        bytes: of all that was sent, with the headers of Ethernet, IP and UDP.
    """

    sent: int
    loss_rate: float
    error_rate: float
    delay: float
    jitter: float
    bytes: int


HEADERS = 14 + 20 + 8


def send(host: str, port: int, rate: float, seconds: float) -> None:
    """Send so many packets a second for so long."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        began, count = time.monotonic(), round(rate * seconds)
        for number in range(count):
            time.sleep(max(0.0, began + number / rate - time.monotonic()))
            out.sendto(LAYOUT.pack(number, time.monotonic_ns(), zlib.crc32(FILLING)) + FILLING, (host, port))
        time.sleep(1.0)
        for _ in range(ENDS):
            out.sendto(LAYOUT.pack(END, count, 0), (host, port))
            time.sleep(0.02)


def receive(port: int) -> Seen:
    """Take packets until the end.

    Raises:
        TimeoutError: there came none for a while.
    """
    delays: dict[int, int] = {}
    wrong = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as came:
        came.bind(("", port))
        came.settimeout(SILENT)
        print("ready", flush=True)
        while True:
            data = came.recv(2048)
            now = time.monotonic_ns()
            number, sent, checksum = LAYOUT.unpack_from(data)
            if number == END:
                return _seen(delays, sent, wrong)
            delays[number] = now - sent
            wrong += zlib.crc32(data[LAYOUT.size :]) != checksum


def _seen(delays: dict[int, int], sent: int, wrong: int) -> Seen:
    numbers = sorted(delays)
    ways = np.array([delays[number] for number in numbers]) / 1e6
    follows = np.diff(numbers) == 1
    return Seen(
        sent=sent,
        loss_rate=1 - len(delays) / sent,
        error_rate=wrong / max(1, len(delays)),
        delay=float(ways.mean()) if len(ways) else float("nan"),
        jitter=float(np.abs(np.diff(ways))[follows].mean()) if follows.any() else 0.0,
        bytes=sent * (LAYOUT.size + len(FILLING) + HEADERS),
    )


def main() -> None:
    """Send or receive, as the arguments say."""
    if sys.argv[1] == "send":
        send(sys.argv[2], int(sys.argv[3]), float(sys.argv[4]), float(sys.argv[5]))
    else:
        print(json.dumps(asdict(receive(int(sys.argv[2])))), flush=True)


if __name__ == "__main__":
    main()
