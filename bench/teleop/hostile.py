"""Who isn't wanted (part of `bench.teleop`): intruders, malformed and replayed datagrams, a flood; a pair drives on.

The pair's video is SRTP as in earnest; what is sent once more by others is to be shown by nobody.

`python -m bench.teleop.hostile HOST PORT RATE SECONDS` is the flood: datagrams that may begin handshakes, and others.
"""

from __future__ import annotations

import itertools
import os
import random
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from scan2sim.services.teleoperation.control.messages import Kind
from scan2sim.services.teleoperation.gateway.fleet import Fleet
from scan2sim.services.teleoperation.gateway.identity import Identity, Role
from scan2sim.services.teleoperation.gateway.json_stream import Client, Stream
from scan2sim.services.teleoperation.gateway.protocol import Address, Ask, Hello
from scan2sim.services.teleoperation.gateway.server import Gateway
from scan2sim.services.teleoperation.qos.measure import delays, gap, missing, percentile
from scan2sim.services.teleoperation.qos.scripted_drive import Heard
from scan2sim.services.teleoperation.transport.dtls_session import is_hello
from scan2sim.services.teleoperation.transport.multipath import Bundle
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.vehicle_side import Link, dial
from scan2sim.services.teleoperation.video.jitter_buffer import Watcher
from scan2sim.services.teleoperation.video.srtp_session import Keys, Sealer
from tests.services.teleoperation.certificates import OTHER, OWN, identity
from tests.services.teleoperation.transport.relay import Relay

Say = Callable[[str], None]
HERE = "127.0.0.1"
LINKS = [Link("a", HERE), Link("b", "127.0.0.2")]
RATE, VIDEO = 50.0, 300.0
"""Messages a second each way, and packets of video."""
TRIES = 3.0
"""Seconds that an intruder tries."""
WARM = 0.2
"""Of the datagrams, after which memory is looked at first: caches are full by then."""
GAP = 100.0
"""Milliseconds between two commands that are allowed."""
PICTURE = struct.pack("<3s3sHH", b"\x10\0\0", b"\x9d\x01\x2a", 640, 480) + bytes(1100)
"""A key frame of VP8, as far as anybody looks who doesn't decode it; one packet."""
TIMES = 10
"""Of the pair's own rate that the flood is."""


class Every(threading.Thread):
    """Does something at a rate, until it is closed."""

    def __init__(self, rate: float, do: Callable[[], object]) -> None:
        super().__init__(daemon=True)
        self._pause, self._do, self._ended = 1 / rate, do, threading.Event()
        self.start()

    def run(self) -> None:
        """Until `close`."""
        due = time.monotonic()
        while not self._ended.is_set():
            due = max(due + self._pause, time.monotonic() - 1.0)
            self._do()
            self._ended.wait(due - time.monotonic())

    def close(self) -> None:
        """Do it no more."""
        self._ended.set()
        self.join()


class Attacked:
    """A pair that is joined and talks, on a network whose datagrams are recorded."""

    def __init__(self) -> None:
        self.car, self.desk = identity(Role.VEHICLE, "car"), identity(Role.STATION, "desk")
        self.listener = Listener(self.desk, [(HERE, 0)])
        self.relay = Relay((HERE, self.listener.port))
        self.relay.recording = True
        self.commands, self.telemetry = Heard(), Heard()
        self.sent, self.shown = 0, list[int]()
        self._keys = Keys(time.monotonic())
        self._sealer = Sealer(self._keys, 0)
        self._sealer.renew(time.monotonic())
        self.watcher = Watcher(
            lambda frame: self.shown.append(frame.captured), lambda _: None, lambda _: 0.0, lambda *_: None, lambda: 0.1
        )
        for key in self._keys.told(time.monotonic()):
            self.watcher.learn(key)
        nothing = lambda message: None  # noqa: E731
        self.station = self.listener.expect(self.car.me, self.telemetry.hearing(nothing), self.watcher.feed)
        self.vehicle = dial(
            self.car, self.desk.me, LINKS, [self.relay.address], received=self.commands.hearing(nothing)
        )
        if not _until(lambda: up(self.station) == up(self.vehicle) == len(LINKS)):
            raise TimeoutError("a pair doesn't come together")
        self.own = list(self.relay._out.values())  # what is sent by these comes from the addresses of its links
        self._talks = [
            Every(RATE, lambda: self.station.send(Kind.COMMAND, bytes(18))),
            Every(RATE, lambda: self.vehicle.send(Kind.TELEMETRY, bytes(200))),
            Every(VIDEO, self._film),
        ]

    def _film(self) -> None:
        self.sent += 1
        for packet in self._sealer.seal(PICTURE, self.sent):
            self.vehicle.send_media(packet)

    def repeated(self) -> int:
        """Pictures that were shown twice, or after a later one."""
        return sum(later <= earlier for earlier, later in itertools.pairwise(self.shown))

    def begin(self) -> None:
        """Note from now on."""
        self.commands.begin()
        self.telemetry.begin()

    def told(self, what: str, say: Say) -> None:
        """How the pair fared since."""
        time.sleep(0.2)
        came, back = self.commands.times(), self.telemetry.times()
        longest = max(gap(came, Kind.COMMAND), gap(back, Kind.TELEMETRY))
        say(
            f"{what}: {len(came)} commands came, {missing(came) + missing(back)} messages didn't, "
            f"{percentile(delays(came, Kind.COMMAND), 95):.0f} ms p95, longest gap {longest:.0f} ms "
            f"({'within' if longest <= GAP else 'BEYOND'} {GAP:g}); links up {up(self.station)}; "
            f"dropped {dict(self.listener.counts)} {dict(self.station.counts)}; of {self.sent} pictures "
            f"{len(self.shown)} shown, {self.repeated()} once more; dropped {dict(self.watcher.counts)}"
        )

    def close(self) -> None:
        """End."""
        for one in self._talks:
            one.close()
        self.vehicle.close()
        self.listener.close()
        self.relay.close()


def up(bundle: Bundle) -> int:
    """Links that are."""
    return sum(link.up for link in bundle.links)


def intruders(pair: Attacked, say: Say) -> int:
    """All that try to drive, to be driven, or to be told anything; how many got in."""
    fresh = {
        "expired": identity(Role.VEHICLE, "car", days=-1),
        "of another authority": identity(Role.VEHICLE, "car", authority=OTHER, believes=OWN),
        "another vehicle": identity(Role.VEHICLE, "van"),
        "another certificate of that name": identity(Role.VEHICLE, "car"),
        "a station as a vehicle": identity(Role.STATION, "car"),
    }
    found = 0
    for who, one in fresh.items():
        heard = Heard()
        bundle = dial(one, pair.desk.me, LINKS, [pair.relay.address], received=heard.hearing(lambda message: None))
        entered = _until(lambda: up(bundle) > 0 or bool(heard.times()), TRIES)  # noqa: B023
        bundle.close()
        found += entered
        say(f"{who}: {'IN' if entered else 'refused'}")
    found += _without(pair.listener.port, say)
    return found + _false_station(pair, say) + _at_gateway(say)


def _without(port: int, say: Say) -> int:
    """Nobody's handshake."""
    from OpenSSL import SSL

    context = SSL.Context(SSL.DTLS_METHOD)
    context.set_verify(SSL.VERIFY_NONE, lambda *_: True)
    client = SSL.Connection(context)
    client.set_connect_state()
    client.set_ciphertext_mtu(1200)
    entered = False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect((HERE, port))
        sock.settimeout(0.5)
        end = time.monotonic() + TRIES
        while time.monotonic() < end and not entered:
            try:
                client.do_handshake()
                entered = True
            except SSL.WantReadError:
                pass
            except SSL.Error:
                break
            try:
                sock.send(client.bio_read(9000))
            except SSL.WantReadError:
                pass
            try:
                client.bio_write(sock.recv(9000))
            except TimeoutError:
                break
    say(f"without a certificate: {'IN' if entered else 'refused'}")
    return int(entered)


def _false_station(pair: Attacked, say: Say) -> int:
    """A vehicle's certificate, and others, where a vehicle dials its station."""
    false = {
        "a vehicle as a station": identity(Role.VEHICLE, "desk"),
        "an expired station": identity(Role.STATION, "desk", days=-1),
        "a station of another authority": identity(Role.STATION, "desk", authority=OTHER, believes=OWN),
        "another station": identity(Role.STATION, "chair"),
    }
    found = 0
    for who, one in false.items():
        listener = Listener(one, [(HERE, 0)])
        station = listener.expect(pair.car.me, lambda message: None)
        vehicle = dial(pair.car, pair.desk.me, LINKS, [(HERE, listener.port)], received=lambda message: None)
        entered = _until(lambda: up(vehicle) > 0, TRIES)  # noqa: B023
        found += entered
        vehicle.close()
        station.close()
        listener.close()
        say(f"{who}: {'IN' if entered else 'refused'}")
    return found


def _at_gateway(say: Say) -> int:
    """Who may not be there, and a vehicle that asks to drive."""
    tries: dict[str, Identity] = {
        "expired": identity(Role.STATION, "desk", days=-1),
        "of another authority": identity(Role.STATION, "desk", authority=OTHER, believes=OWN),
        "a vehicle that asks to drive": identity(Role.VEHICLE, "van"),
    }
    found = 0
    with tempfile.TemporaryDirectory() as name:
        fleet = Fleet(Path(name))
        gateway = Gateway(identity(Role.GATEWAY, HERE), HERE, 0, fleet, lambda _: None)
        good = _client(identity(Role.VEHICLE, "car"), gateway.port)
        if not _until(lambda: bool(fleet.facts()["vehicles"])):
            raise TimeoutError("a vehicle isn't let in at the gateway")
        for who, one in tries.items():
            client = _client(one, gateway.port)
            entered = _until(
                lambda: bool(fleet.facts()["stations"]) or any(car["other"] for car in fleet.facts()["vehicles"]),
                TRIES,
            )
            client.close()
            found += entered
            say(f"at the gateway, {who}: {'IN' if entered else 'refused'}")
        good.close()
        gateway.close()
    return found


def _client(who: Identity, port: int) -> Client:
    def opened(stream: Stream) -> None:
        stream.send(Hello(listening=(Address(host=HERE, port=7444),)).wire())
        stream.send(Ask(what="join", vehicle="car").wire())

    return Client(who, HERE, port, opened=opened, received=lambda stream, told: None, closed=lambda why: None)


def datagrams(pair: Attacked, count: int, say: Say) -> float:
    """Malformed, forged and replayed ones, messages and video, of strangers and of the pair's own addresses.

    Returns:
        Growth of this process's memory meanwhile, as a share of it.
    """
    kept, chance = [data for _, data in pair.relay.passed], random.Random(4)
    strangers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(8)]
    process, before = psutil.Process(), 0
    for number in range(count):
        data = bytearray(chance.choice(kept))
        if number % 3 == 1:
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        elif number % 3 == 2:
            data = bytearray(chance.randbytes(chance.randrange(0, 2000)))
        chance.choice(strangers if number % 2 else pair.own).sendto(data, (HERE, pair.listener.port))
        if number % 10 == 0:
            time.sleep(0.003)
        if number == round(WARM * count):
            before = process.memory_info().rss
        if number % 20_000 == 19_999:
            say(f"{number + 1} datagrams")
    time.sleep(0.5)
    after = process.memory_info().rss
    for sock in strangers:
        sock.close()
    say(f"memory: {before / 2**20:.1f} MB, then {after / 2**20:.1f}")
    return after / before - 1


def flooded(pair: Attacked, seconds: float, say: Say) -> float:
    """A flood of ten times the pair's rate by another process; growth of memory meanwhile, as a share."""
    before, began = sum(link.bytes_in for link in pair.station.links), time.monotonic()
    time.sleep(2.0)
    moved = (sum(link.bytes_in for link in pair.station.links) - before) / (time.monotonic() - began)
    rate = TIMES * len(LINKS) * (RATE + VIDEO + 10)  # and pings
    say(f"the pair sends {moved * 8e-6:.1f} Mbit/s; {rate:.0f} datagrams a second flood it")
    command = [sys.executable, "-m", __spec__.name, HERE, pair.listener.port, rate, seconds]
    flood = subprocess.Popen([str(part) for part in command], stdout=subprocess.PIPE, text=True)
    process = psutil.Process()
    time.sleep(WARM * seconds)
    at_first = process.memory_info().rss
    sent, _ = flood.communicate()
    say(f"{sent.strip()} datagrams in {seconds:.0f} s")
    return process.memory_info().rss / at_first - 1


def flood(host: str, port: int, rate: float, seconds: float) -> int:
    """Send; how many were."""
    socks = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(4)]
    for number, sock in enumerate(socks):
        sock.bind((f"127.0.1.{number}", 0))
    record = b"\x16\xfe\xfd" + bytes(8)
    hello = record + (200).to_bytes(2, "big") + b"\x01" + os.urandom(199)
    kinds, sent, began = (hello, os.urandom(1000), b"\x80" + bytes(1199), hello[:50]), 0, time.monotonic()
    while (passed := time.monotonic() - began) < seconds:
        while sent < passed * rate:
            socks[sent % 4].sendto(kinds[sent // 4 % 4], (host, port))
            sent += 1
        time.sleep(0.001)
    return sent


def hostile(scale: float, say: Say) -> dict[str, Any]:
    """All of them, while a pair talks."""
    pair = Attacked()
    try:
        time.sleep(3.0)
        pair.told("in peace", say)
        pair.relay.recording = False
        assert any(is_hello(data) for _, data in pair.relay.passed)
        pair.begin()
        found = intruders(pair, say)
        pair.told("with intruders", say)
        pair.begin()
        grown = datagrams(pair, max(5000, round(100_000 * scale)), say)
        pair.told("with malformed and replayed datagrams", say)
        pair.begin()
        grown = max(grown, flooded(pair, max(5.0, 30.0 * scale), say))
        pair.told("in the flood", say)
    finally:
        pair.close()
    return {"intruders_in": found, "replayed_shown": pair.repeated(), "memory_growth": round(grown, 4)}


def _until(true: Callable[[], bool], seconds: float = 20.0) -> bool:
    end = time.monotonic() + seconds
    while not (found := true()) and time.monotonic() < end:
        time.sleep(0.02)
    return found


if __name__ == "__main__":
    print(flood(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])))
