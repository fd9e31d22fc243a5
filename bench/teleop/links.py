"""Cost of a vehicle's links: CPU time of both ends, and delivery of messages and video.

`python -m bench.teleop.links [--seconds 20] [--packets 600] [--rate 50]`: a vehicle and a station, each a process on
this machine: video over two links, messages both ways. Ends with a line `RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import multiprocessing.connection
import resource
import time
from typing import Any

from scan2sim.services.teleoperation.control.messages import Kind, Message
from scan2sim.services.teleoperation.gateway.pki import Authority
from scan2sim.services.teleoperation.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.transport.clock_sync import ClockSync
from scan2sim.services.teleoperation.transport.multipath import MultipathConnection, Policy
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.vehicle_side import Link, connect_station

LINKS = [Link("a", "127.0.0.1"), Link("b", "127.0.0.2")]
PACKET = b"\x80" + bytes(1099)


class Receiver:
    """Ages of messages when received, and the intervals between them, ms."""

    def __init__(self) -> None:
        self.clocks = ClockSync()
        self.ages: list[float] = []
        self.gaps: list[float] = []
        self.packets = 0
        self._last = 0.0

    def received(self, message: Message) -> None:
        """Handle a message."""
        now = time.monotonic()
        if self._last:
            self.gaps.append((now - self._last) * 1e3)
        self._last = now
        self.ages.append(self.clocks.age_ms(message.sent))

    def media(self, packet: bytes, link: str) -> None:
        """Handle a video packet."""
        self.packets += 1

    def result(self, cpu_seconds: float, seconds: float) -> dict[str, Any]:
        """Results for RESULT."""
        ages = sorted(self.ages) or [float("nan")]
        return {
            "cores": round(cpu_seconds / seconds, 3),
            "messages": len(self.ages),
            "age_p50_ms": round(ages[len(ages) // 2], 2),
            "age_p99_ms": round(ages[len(ages) * 99 // 100], 2),
            "gap_max_ms": round(max(self.gaps, default=float("nan")), 1),
            "packets": self.packets,
        }


def drive(
    connection: MultipathConnection, receiver: Receiver, kind: Kind, given: argparse.Namespace, packets: int
) -> dict[str, Any]:
    """Send messages and packets at the given rates and duration."""
    while sum(link.up for link in connection.links) < len(LINKS):
        time.sleep(0.01)
    used, begun = resource.getrusage(resource.RUSAGE_SELF), time.monotonic()
    sent = shown = 0
    while (now := time.monotonic() - begun) < given.seconds:
        while sent < now * given.rate:
            connection.send(kind, bytes(18))
            sent += 1
        while shown < now * packets:
            connection.send_media(PACKET, Policy.COPY)
            shown += 1
        time.sleep(0.005)
    spent = resource.getrusage(resource.RUSAGE_SELF)
    time.sleep(0.5)
    return receiver.result(spent.ru_utime + spent.ru_stime - used.ru_utime - used.ru_stime, given.seconds)


def vehicle(me: Identity, peer: Peer, given: argparse.Namespace, pipe: multiprocessing.connection.Connection) -> None:
    """Process of the vehicle."""
    receiver = Receiver()
    connection = connect_station(
        me,
        peer,
        LINKS,
        [("127.0.0.1", pipe.recv())],
        received=receiver.received,
        media=receiver.media,
        clocks=receiver.clocks,
    )
    pipe.send(drive(connection, receiver, Kind.TELEMETRY, given, given.packets))
    connection.close()


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--packets", type=int, default=600, help="video packets per second")
    parser.add_argument("--rate", type=int, default=50, help="messages per second, each way")
    given = parser.parse_args()
    authority = Authority.make()
    parties = []
    for role in (Role.VEHICLE, Role.STATION):
        certificate, key = authority.certify(role, "bench", 1)
        parties.append(Identity(Peer.from_certificate(certificate), certificate, key, authority.certificate))
    car, desk = parties
    parent_end, child_end = multiprocessing.Pipe()
    fork = multiprocessing.get_context("fork")
    child = fork.Process(target=vehicle, args=(car, desk.me, given, child_end), daemon=True)
    child.start()
    receiver = Receiver()
    listener = Listener(desk, [("127.0.0.1", 0)])
    connection = listener.expect(car.me, receiver.received, receiver.media, clocks=receiver.clocks)
    parent_end.send(listener.port)
    station = drive(connection, receiver, Kind.COMMAND, given, 0)
    result = {"vehicle": parent_end.recv(), "station": station, "links": [link.name for link in connection.links]}
    child.join()
    listener.close()
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()
