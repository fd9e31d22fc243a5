"""Network probe: sends numbered, timestamped datagrams beside other traffic and measures loss, delay and jitter.

`python -m scan2sim.services.qos.probe receive PORT` and `... send HOST PORT RATE SECONDS`. Both ends must share a
clock, like two namespaces of one machine. At the end, the receiver prints one line of JSON (`ProbeResult`).
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

from scan2sim.services.qos.confidence import share_bounds

PACKET_FORMAT = struct.Struct("!QQI")
"""Sequence number, send time in ns, CRC-32 of the payload."""
PAYLOAD = bytes(range(64))
END_NUMBER = 2**64 - 1
"""Sequence number of the last datagrams, which contain the number of datagrams in place of a time."""
END_REPEATS = 20
RECEIVE_TIMEOUT_S = 10.0
"""Seconds without a datagram after which the receiver gives up."""


@dataclass(frozen=True)
class ProbeResult:
    """Result of a probe.

    Attributes:
        sent: number of datagrams.
        loss_rate: share of sent datagrams that were lost.
        error_rate: share of received datagrams that were corrupted.
        delay, jitter: mean delay, and mean difference between the delays of successive datagrams (RFC 3393), ms.
        bytes: total size of sent datagrams with Ethernet, IP and UDP headers.
    """

    sent: int
    loss_rate: float
    error_rate: float
    delay: float
    jitter: float
    bytes: int

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Confidence bounds of the loss rate and the error rate."""
        lost = round(self.loss_rate * self.sent)
        received = self.sent - lost
        return {
            "loss_rate": share_bounds(lost, self.sent),
            "error_rate": share_bounds(round(self.error_rate * received), max(1, received)),
        }


HEADER_BYTES = 14 + 20 + 8


def packet(number: int, now: int) -> bytes:
    """Datagram sent at time `now` (ns)."""
    return PACKET_FORMAT.pack(number, now, zlib.crc32(PAYLOAD)) + PAYLOAD


def end_packet(count: int) -> bytes:
    """Datagram sent after `count` others, at the end of the probe."""
    return PACKET_FORMAT.pack(END_NUMBER, count, 0)


def send(host: str, port: int, rate: float, seconds: float) -> None:
    """Send `rate` datagrams per second for `seconds`."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        began, count = time.monotonic(), round(rate * seconds)
        for number in range(count):
            time.sleep(max(0.0, began + number / rate - time.monotonic()))
            out.sendto(packet(number, time.monotonic_ns()), (host, port))
        time.sleep(1.0)
        for _ in range(END_REPEATS):
            out.sendto(end_packet(count), (host, port))
            time.sleep(0.02)


def receive(port: int) -> ProbeResult:
    """Receive datagrams until the end of the probe.

    Raises:
        TimeoutError: no datagram was received for `RECEIVE_TIMEOUT_S`.
    """
    statistics = ProbeStatistics()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as incoming:
        incoming.bind(("", port))
        incoming.settimeout(RECEIVE_TIMEOUT_S)
        print("ready", flush=True)
        while True:
            data = incoming.recv(2048)
            if result := statistics.receive(data, time.monotonic_ns()):
                return result


class ProbeStatistics:
    """Statistics of received datagrams."""

    def __init__(self) -> None:
        self._delays: dict[int, int] = {}
        self._corrupted = 0

    def receive(self, data: bytes, now: int) -> ProbeResult | None:
        """Process a datagram received at time `now` (ns); returns the result at the end of the probe."""
        number, sent, checksum = PACKET_FORMAT.unpack_from(data)
        if number == END_NUMBER:
            return _result(self._delays, sent, self._corrupted)
        self._delays[number] = now - sent
        self._corrupted += zlib.crc32(data[PACKET_FORMAT.size :]) != checksum
        return None


def _result(delays: dict[int, int], sent: int, corrupted: int) -> ProbeResult:
    numbers = sorted(delays)
    delays_ms = np.array([delays[number] for number in numbers]) / 1e6
    successive = np.diff(numbers) == 1
    return ProbeResult(
        sent=sent,
        loss_rate=1 - len(delays) / sent,
        error_rate=corrupted / max(1, len(delays)),
        delay=float(delays_ms.mean()) if len(delays_ms) else float("nan"),
        jitter=float(np.abs(np.diff(delays_ms))[successive].mean()) if successive.any() else 0.0,
        bytes=sent * (PACKET_FORMAT.size + len(PAYLOAD) + HEADER_BYTES),
    )


def main() -> None:
    """Send or receive according to the arguments."""
    if sys.argv[1] == "send":
        send(sys.argv[2], int(sys.argv[3]), float(sys.argv[4]), float(sys.argv[5]))
    else:
        print(json.dumps(asdict(receive(int(sys.argv[2])))), flush=True)


if __name__ == "__main__":
    main()
