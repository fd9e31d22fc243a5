"""Attacks (part of `bench.teleop`): intruders, malformed and replayed datagrams, a flood, while a pair is driving.

The pair's video is SRTP as in production; replayed packets must not be displayed.

`python -m bench.teleop.hostile HOST PORT MESSAGE_RATE SECONDS` is the flood: client hellos and other datagrams.
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
from scan2sim.services.teleoperation.gateway.json_stream import Client, Connection
from scan2sim.services.teleoperation.gateway.protocol import Address, DriverRequest, Hello
from scan2sim.services.teleoperation.gateway.server import Gateway
from scan2sim.services.teleoperation.qos.measure import count_missing, delays, longest_gap, percentile
from scan2sim.services.teleoperation.qos.scripted_drive import MessageRecorder
from scan2sim.services.teleoperation.transport.dtls_session import is_hello
from scan2sim.services.teleoperation.transport.multipath import MultipathConnection
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.vehicle_side import Link, connect_station
from scan2sim.services.teleoperation.video.jitter_buffer import VideoReceiver
from scan2sim.services.teleoperation.video.srtp_session import KeySchedule, PacketEncryptor
from tests.fakes.certificates import OTHER, OWN, identity
from tests.fakes.relay import Relay

Report = Callable[[str], None]
HERE = "127.0.0.1"
LINKS = [Link("a", HERE), Link("b", "127.0.0.2")]
MESSAGE_RATE, VIDEO_RATE = 50.0, 300.0
"""Messages per second each way, and video packets per second."""
INTRUSION_S = 3.0
"""Duration of an intrusion attempt."""
WARM_UP_SHARE = 0.2
"""Share of the datagrams before memory is first measured, when caches are full."""
MAX_GAP_MS = 100.0
"""Maximum interval between two commands."""
KEY_FRAME = struct.pack("<3s3sHH", b"\x10\0\0", b"\x9d\x01\x2a", 640, 480) + bytes(1100)
"""A VP8 key frame with a valid header; one packet."""
FLOOD_FACTOR = 10
"""Rate of the flood as a multiple of the pair's own rate."""


class RepeatingThread(threading.Thread):
    """Calls a function at a fixed rate until it is closed."""

    def __init__(self, rate: float, do: Callable[[], object]) -> None:
        super().__init__(daemon=True)
        self._pause, self._do, self._ended = 1 / rate, do, threading.Event()
        self.start()

    def run(self) -> None:
        """Run until `close`."""
        due = time.monotonic()
        while not self._ended.is_set():
            due = max(due + self._pause, time.monotonic() - 1.0)
            self._do()
            self._ended.wait(due - time.monotonic())

    def close(self) -> None:
        """Stop and wait for the end."""
        self._ended.set()
        self.join()


class AttackedPair:
    """A joined pair exchanging messages over a network that records its datagrams."""

    def __init__(self) -> None:
        self.car, self.desk = identity(Role.VEHICLE, "car"), identity(Role.STATION, "desk")
        self.listener = Listener(self.desk, [(HERE, 0)])
        self.relay = Relay((HERE, self.listener.port))
        self.relay.recording = True
        self.commands, self.telemetry = MessageRecorder(), MessageRecorder()
        self.sent, self.shown = 0, list[int]()
        self._keys = KeySchedule(time.monotonic())
        self._encryptor = PacketEncryptor(self._keys, 0)
        self._encryptor.update_key(time.monotonic())
        self.receiver = VideoReceiver(
            lambda frame: self.shown.append(frame.captured), lambda _: None, lambda _: 0.0, lambda *_: None, lambda: 0.1
        )
        for key in self._keys.announced(time.monotonic()):
            self.receiver.add_key(key)
        nothing = lambda message: None  # noqa: E731
        self.station = self.listener.expect(self.car.me, self.telemetry.recording(nothing), self.receiver.feed)
        self.vehicle = connect_station(
            self.car, self.desk.me, LINKS, [self.relay.address], received=self.commands.recording(nothing)
        )
        if not _until(lambda: up(self.station) == up(self.vehicle) == len(LINKS)):
            raise TimeoutError("the pair didn't connect")
        self.own = list(self.relay._out.values())  # these sockets send from the addresses of its links
        self._talks = [
            RepeatingThread(MESSAGE_RATE, lambda: self.station.send(Kind.COMMAND, bytes(18))),
            RepeatingThread(MESSAGE_RATE, lambda: self.vehicle.send(Kind.TELEMETRY, bytes(200))),
            RepeatingThread(VIDEO_RATE, self._film),
        ]

    def _film(self) -> None:
        self.sent += 1
        for packet in self._encryptor.encrypt(KEY_FRAME, self.sent):
            self.vehicle.send_media(packet)

    def repeated(self) -> int:
        """Number of frames displayed twice or out of order."""
        return sum(later <= earlier for earlier, later in itertools.pairwise(self.shown))

    def begin(self) -> None:
        """Start recording messages."""
        self.commands.begin()
        self.telemetry.begin()

    def report_state(self, what: str, report: Report) -> None:
        """Report how the pair was affected since `begin`."""
        time.sleep(0.2)
        received, back = self.commands.times(), self.telemetry.times()
        longest = max(longest_gap(received, Kind.COMMAND), longest_gap(back, Kind.TELEMETRY))
        report(
            f"{what}: {len(received)} commands received, {count_missing(received) + count_missing(back)} messages "
            f"lost, "
            f"{percentile(delays(received, Kind.COMMAND), 95):.0f} ms p95, longest gap {longest:.0f} ms "
            f"({'within' if longest <= MAX_GAP_MS else 'BEYOND'} {MAX_GAP_MS:g}); links up {up(self.station)}; "
            f"dropped {dict(self.listener.counts)} {dict(self.station.counts)}; of {self.sent} frames "
            f"{len(self.shown)} shown, {self.repeated()} repeated; dropped {dict(self.receiver.counts)}"
        )

    def close(self) -> None:
        """Stop the pair."""
        for one in self._talks:
            one.close()
        self.vehicle.close()
        self.listener.close()
        self.relay.close()


def up(connection: MultipathConnection) -> int:
    """Number of links that are up."""
    return sum(link.up for link in connection.links)


def intruders(pair: AttackedPair, report: Report) -> int:
    """Attempts to drive, to be driven or to receive anything; returns how many succeeded."""
    fresh = {
        "expired": identity(Role.VEHICLE, "car", days=-1),
        "of another authority": identity(Role.VEHICLE, "car", authority=OTHER, trusts=OWN),
        "another vehicle": identity(Role.VEHICLE, "van"),
        "another certificate of that name": identity(Role.VEHICLE, "car"),
        "a station as a vehicle": identity(Role.STATION, "car"),
    }
    accepted = 0
    for who, one in fresh.items():
        heard = MessageRecorder()
        connection = connect_station(
            one, pair.desk.me, LINKS, [pair.relay.address], received=heard.recording(lambda message: None)
        )
        entered = _until(lambda: up(connection) > 0 or bool(heard.times()), INTRUSION_S)  # noqa: B023
        connection.close()
        accepted += entered
        report(f"{who}: {'IN' if entered else 'rejected'}")
    accepted += _without_certificate(pair.listener.port, report)
    return accepted + _false_station(pair, report) + _at_gateway(report)


def _without_certificate(port: int, report: Report) -> int:
    """Handshake without a certificate."""
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
        end = time.monotonic() + INTRUSION_S
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
    report(f"without a certificate: {'IN' if entered else 'rejected'}")
    return int(entered)


def _false_station(pair: AttackedPair, report: Report) -> int:
    """A vehicle's certificate and invalid ones, presented to a vehicle that connects to its station."""
    false = {
        "a vehicle as a station": identity(Role.VEHICLE, "desk"),
        "an expired station": identity(Role.STATION, "desk", days=-1),
        "a station of another authority": identity(Role.STATION, "desk", authority=OTHER, trusts=OWN),
        "another station": identity(Role.STATION, "chair"),
    }
    found = 0
    for who, one in false.items():
        listener = Listener(one, [(HERE, 0)])
        station = listener.expect(pair.car.me, lambda message: None)
        vehicle = connect_station(pair.car, pair.desk.me, LINKS, [(HERE, listener.port)], received=lambda message: None)
        entered = _until(lambda: up(vehicle) > 0, INTRUSION_S)  # noqa: B023
        found += entered
        vehicle.close()
        station.close()
        listener.close()
        report(f"{who}: {'IN' if entered else 'rejected'}")
    return found


def _at_gateway(report: Report) -> int:
    """Invalid certificates at the gateway, and a vehicle that requests to drive."""
    tries: dict[str, Identity] = {
        "expired": identity(Role.STATION, "desk", days=-1),
        "of another authority": identity(Role.STATION, "desk", authority=OTHER, trusts=OWN),
        "a vehicle that asks to drive": identity(Role.VEHICLE, "van"),
    }
    found = 0
    with tempfile.TemporaryDirectory() as name:
        fleet = Fleet(Path(name))
        gateway = Gateway(identity(Role.GATEWAY, HERE), HERE, 0, fleet, lambda _: None)
        good = _client(identity(Role.VEHICLE, "car"), gateway.port)
        if not _until(lambda: bool(fleet.snapshot()["vehicles"])):
            raise TimeoutError("the gateway doesn't accept a valid vehicle")
        for who, one in tries.items():
            client = _client(one, gateway.port)
            entered = _until(
                lambda: bool(fleet.snapshot()["stations"]) or any(car["other"] for car in fleet.snapshot()["vehicles"]),
                INTRUSION_S,
            )
            client.close()
            found += entered
            report(f"at the gateway, {who}: {'IN' if entered else 'rejected'}")
        good.close()
        gateway.close()
    return found


def _client(who: Identity, port: int) -> Client:
    def opened(stream: Connection) -> None:
        stream.send(Hello(listening=(Address(host=HERE, port=7444),)).wire())
        stream.send(DriverRequest(what="join", vehicle="car").wire())

    return Client(who, HERE, port, opened=opened, received=lambda stream, message: None, closed=lambda reason: None)


def datagrams(pair: AttackedPair, count: int, report: Report) -> float:
    """Malformed, forged and replayed datagrams of messages and video, from strangers and from the pair's own addresses.

    Returns:
        relative growth of this process's memory.
    """
    kept, chance = [data for _, data in pair.relay.recorded], random.Random(4)
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
        if number == round(WARM_UP_SHARE * count):
            before = process.memory_info().rss
        if number % 20_000 == 19_999:
            report(f"{number + 1} datagrams")
    time.sleep(0.5)
    after = process.memory_info().rss
    for sock in strangers:
        sock.close()
    report(f"memory: {before / 2**20:.1f} MB, then {after / 2**20:.1f}")
    return after / before - 1


def flood_pair(pair: AttackedPair, seconds: float, report: Report) -> float:
    """Flood with ten times the pair's rate from another process; returns the relative growth of memory."""
    before, began = sum(link.bytes_in for link in pair.station.links), time.monotonic()
    time.sleep(2.0)
    moved = (sum(link.bytes_in for link in pair.station.links) - before) / (time.monotonic() - began)
    rate = FLOOD_FACTOR * len(LINKS) * (MESSAGE_RATE + VIDEO_RATE + 10)  # and pings
    report(f"the pair sends {moved * 8e-6:.1f} Mbit/s; the flood has {rate:.0f} datagrams/s")
    command = [sys.executable, "-m", __spec__.name, HERE, pair.listener.port, rate, seconds]
    flood = subprocess.Popen([str(part) for part in command], stdout=subprocess.PIPE, text=True)
    process = psutil.Process()
    time.sleep(WARM_UP_SHARE * seconds)
    at_first = process.memory_info().rss
    sent, _ = flood.communicate()
    report(f"{sent.strip()} datagrams in {seconds:.0f} s")
    return process.memory_info().rss / at_first - 1


def flood(host: str, port: int, rate: float, seconds: float) -> int:
    """Send the flood; returns the number of datagrams."""
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


def hostile(scale: float, report: Report) -> dict[str, Any]:
    """Run all attacks while a pair is driving."""
    pair = AttackedPair()
    try:
        time.sleep(3.0)
        pair.report_state("without attack", report)
        pair.relay.recording = False
        assert any(is_hello(data) for _, data in pair.relay.recorded)
        pair.begin()
        found = intruders(pair, report)
        pair.report_state("with intruders", report)
        pair.begin()
        growth = datagrams(pair, max(5000, round(100_000 * scale)), report)
        pair.report_state("with malformed and replayed datagrams", report)
        pair.begin()
        growth = max(growth, flood_pair(pair, max(5.0, 30.0 * scale), report))
        pair.report_state("during the flood", report)
    finally:
        pair.close()
    return {"intruders_in": found, "replayed_shown": pair.repeated(), "memory_growth": round(growth, 4)}


def _until(true: Callable[[], bool], seconds: float = 20.0) -> bool:
    end = time.monotonic() + seconds
    while not (found := true()) and time.monotonic() < end:
        time.sleep(0.02)
    return found


if __name__ == "__main__":
    print(flood(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])))
