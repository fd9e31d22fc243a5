"""What the links of a vehicle cost: processor time of both ends, and how messages and video come through.

`python -m bench.teleop.links [--seconds 20] [--packets 600] [--rate 50]`: a vehicle and a station, each a process, on
this machine: video over two links at that rate, messages both ways. It ends with a line `RESULT {json}`.
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
from scan2sim.services.teleoperation.gateway.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.gateway.pki import Authority
from scan2sim.services.teleoperation.transport.clock_sync import Clocks
from scan2sim.services.teleoperation.transport.multipath import Bundle, Policy
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.vehicle_side import Link, dial

LINKS = [Link("a", "127.0.0.1"), Link("b", "127.0.0.2")]
PACKET = b"\x80" + bytes(1099)


class Ages:
    """How old messages were when they came, and the time between them, ms."""

    def __init__(self) -> None:
        self.clocks = Clocks()
        self.ages: list[float] = []
        self.gaps: list[float] = []
        self.packets = 0
        self._last = 0.0

    def received(self, message: Message) -> None:
        """A message came."""
        now = time.monotonic()
        if self._last:
            self.gaps.append((now - self._last) * 1e3)
        self._last = now
        self.ages.append(self.clocks.age_ms(message.sent))

    def media(self, packet: bytes, link: str) -> None:
        """A packet of video came."""
        self.packets += 1

    def told(self, spent: float, seconds: float) -> dict[str, Any]:
        """What came of it."""
        ages = sorted(self.ages) or [float("nan")]
        return {
            "cores": round(spent / seconds, 3),
            "messages": len(self.ages),
            "age_p50_ms": round(ages[len(ages) // 2], 2),
            "age_p99_ms": round(ages[len(ages) * 99 // 100], 2),
            "gap_max_ms": round(max(self.gaps, default=float("nan")), 1),
            "packets": self.packets,
        }


def drive(bundle: Bundle, ages: Ages, kind: Kind, given: argparse.Namespace, packets: int) -> dict[str, Any]:
    """Send at the rates for so long."""
    while sum(link.up for link in bundle.links) < len(LINKS):
        time.sleep(0.01)
    used, begun = resource.getrusage(resource.RUSAGE_SELF), time.monotonic()
    sent = shown = 0
    while (now := time.monotonic() - begun) < given.seconds:
        while sent < now * given.rate:
            bundle.send(kind, bytes(18))
            sent += 1
        while shown < now * packets:
            bundle.send_media(PACKET, Policy.COPY)
            shown += 1
        time.sleep(0.005)
    spent = resource.getrusage(resource.RUSAGE_SELF)
    time.sleep(0.5)
    return ages.told(spent.ru_utime + spent.ru_stime - used.ru_utime - used.ru_stime, given.seconds)


def vehicle(me: Identity, peer: Peer, given: argparse.Namespace, pipe: multiprocessing.connection.Connection) -> None:
    """The process of a vehicle."""
    ages = Ages()
    bundle = dial(
        me, peer, LINKS, [("127.0.0.1", pipe.recv())], received=ages.received, media=ages.media, clocks=ages.clocks
    )
    pipe.send(drive(bundle, ages, Kind.TELEMETRY, given, given.packets))
    bundle.close()


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--packets", type=int, default=600, help="of video, a second")
    parser.add_argument("--rate", type=int, default=50, help="messages a second, each way")
    given = parser.parse_args()
    authority = Authority.make()
    parties = []
    for role in (Role.VEHICLE, Role.STATION):
        certificate, key = authority.certify(role, "bench", 1)
        parties.append(Identity(Peer.of(certificate), certificate, key, authority.certificate))
    car, desk = parties
    here, there = multiprocessing.Pipe()
    fork = multiprocessing.get_context("fork")
    child = fork.Process(target=vehicle, args=(car, desk.me, given, there), daemon=True)
    child.start()
    ages = Ages()
    listener = Listener(desk, [("127.0.0.1", 0)])
    bundle = listener.expect(car.me, ages.received, ages.media, clocks=ages.clocks)
    here.send(listener.port)
    station = drive(bundle, ages, Kind.COMMAND, given, 0)
    result = {"vehicle": here.recv(), "station": station, "links": [link.name for link in bundle.links]}
    child.join()
    listener.close()
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()
