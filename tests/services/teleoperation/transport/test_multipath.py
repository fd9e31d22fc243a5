"""A vehicle and a station over links that are cut, slow and attacked."""

from __future__ import annotations

import gc
import os
import random
import socket
import struct
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import BusyError, SettingError
from scan2sim.services.teleoperation.control.messages import Kind, Message
from scan2sim.services.teleoperation.gateway.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.transport import multipath, station_side
from scan2sim.services.teleoperation.transport.clock_sync import ClockSync
from scan2sim.services.teleoperation.transport.dtls_session import count_records, is_hello
from scan2sim.services.teleoperation.transport.multipath import MultipathConnection, Policy
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.vehicle_side import Link, connect_station
from tests.fakes.certificates import OTHER, OWN, identity
from tests.fakes.relay import Relay
from tests.waiting import until

CAR, DESK = identity(Role.VEHICLE, "car"), identity(Role.STATION, "desk")
A, B = Link("a", "127.0.0.1"), Link("b", "127.0.0.2")


class MessageRecorder:
    """Records what one side receives."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self.packets: list[tuple[bytes, str]] = []
        self.starts = 0

    def restarted(self) -> None:
        self.starts += 1

    @property
    def callbacks(self) -> dict[str, Any]:
        return {
            "received": self.messages.append,
            "media": lambda packet, link: self.packets.append((packet, link)),
            "restarted": self.restarted,
        }

    def numbers(self) -> list[int]:
        return [struct.unpack("<I", one.body)[0] for one in self.messages]


class World:
    """A station, a vehicle, and the network between them."""

    def __init__(self) -> None:
        self.listener = Listener(DESK, [("127.0.0.1", 0)])
        self.relay = Relay(("127.0.0.1", self.listener.port))
        self.ends: list[Callable[[], None]] = [self.relay.close, lambda: self.listener.close()]
        self.station, self.vehicle = MessageRecorder(), MessageRecorder()

    def expect(self, peer: Peer = CAR.me, **more: Any) -> MultipathConnection:
        return self.listener.expect(peer, **(self.station.callbacks | more))

    def connect(
        self, party: Identity = CAR, peer: Peer = DESK.me, recorder: MessageRecorder | None = None, **more: Any
    ) -> MultipathConnection:
        made = connect_station(
            party, peer, more.pop("links", [A, B]), [self.relay.address], **(recorder or self.vehicle).callbacks, **more
        )
        self.ends.insert(0, made.close)
        return made


@pytest.fixture
def world() -> Iterator[World]:
    made = World()
    yield made
    for end in made.ends:
        end()


def up(connection: MultipathConnection, count: int = 2) -> bool:
    return sum(link.up for link in connection.links) == count


class Talk(threading.Thread):
    """Sends numbered messages at a rate until stopped."""

    def __init__(self, connection: MultipathConnection, kind: Kind = Kind.COMMAND, rate: float = 50) -> None:
        super().__init__(daemon=True)
        self._connection, self._kind, self._pause = connection, kind, 1 / rate
        self._stopping = threading.Event()
        self.sent = 0
        self.start()

    def run(self) -> None:
        while not self._stopping.wait(self._pause):
            self._connection.send(self._kind, struct.pack("<I", self.sent))
            self.sent += 1

    def stop(self) -> int:
        self._stopping.set()
        self.join()
        return self.sent


def test_messages_arrive_once_in_both_directions_over_two_links(world: World) -> None:
    world.relay.shapes["127.0.0.1"].duplication = 0.3
    station, vehicle = world.expect(), world.connect()
    until(lambda: up(station) and up(vehicle) and world.station.starts and world.vehicle.starts)
    talks = Talk(station, rate=200), Talk(vehicle, Kind.TELEMETRY, rate=200)
    time.sleep(1)
    down, back = (talk.stop() for talk in talks)
    until(lambda: len(world.vehicle.messages) == down and len(world.station.messages) == back)
    assert world.vehicle.numbers() == list(range(down)) and world.station.numbers() == list(range(back))
    until(lambda: vehicle.counts.get("doubles") == down)
    assert {link.name for link in station.links} == {link.name for link in vehicle.links} == {"a", "b"}
    for link in vehicle.links:
        assert link.handshake_s > 0 and link.round_trip_ms > 0 and link.bytes_in > 3000 and link.remote
        assert link.cipher == "DTLSv1.2 ECDHE-ECDSA-CHACHA20-POLY1305 x25519"


def test_cutting_and_restoring_one_of_two_links_loses_and_duplicates_nothing(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.setattr(multipath, "RECEIVE_TIMEOUT_S", 3.0)  # a machine that runs tests is busy
    monkeypatch.setattr(multipath, "PONG_TIMEOUT_S", 6.0)
    for host in ("127.0.0.1", "127.0.0.2"):
        world.relay.shapes[host].delay, world.relay.shapes[host].jitter = 0.02, 0.01
    station, vehicle = world.expect(), world.connect()
    until(lambda: up(station) and up(vehicle))
    talks = Talk(station), Talk(vehicle, Kind.TELEMETRY)
    for host in ("127.0.0.1", "127.0.0.2"):
        world.relay.shapes[host].cut = True
        until(lambda: up(station, 1) and up(vehicle, 1))
        time.sleep(1)
        world.relay.shapes[host].cut = False
        until(lambda: up(station) and up(vehicle))
    down, back = (talk.stop() for talk in talks)
    until(lambda: len(world.vehicle.messages) >= down and len(world.station.messages) >= back)
    time.sleep(0.1)
    assert sorted(world.vehicle.numbers()) == list(range(down)) and sorted(world.station.numbers()) == list(range(back))


def test_losses_of_one_link_are_compensated_by_the_other_and_measured(world: World) -> None:
    world.relay.shapes["127.0.0.2"].loss = 0.3
    station, vehicle = world.expect(), world.connect()
    until(lambda: up(station) and up(vehicle))
    talk = Talk(station, rate=100)
    time.sleep(3)
    sent = talk.stop()
    until(lambda: len(world.vehicle.messages) == sent)
    loss = {link.name: link.loss for link in vehicle.links}
    assert loss["a"] < 0.05 and 0.1 < loss["b"] < 0.5
    there = {link.name: link.loss_there for link in station.links}
    assert there["a"] < 0.05 < there["b"]


def test_both_links_cut_are_reported_and_recover(world: World) -> None:
    station, vehicle = world.expect(), world.connect()
    until(lambda: up(station) and up(vehicle))
    for host in ("127.0.0.1", "127.0.0.2"):
        world.relay.shapes[host].cut = True
    until(lambda: up(station, 0) and up(vehicle, 0))
    assert all(link.why for link in vehicle.links)
    time.sleep(1.5)
    for host in ("127.0.0.1", "127.0.0.2"):
        world.relay.shapes[host].cut = False
    until(lambda: up(station) and up(vehicle))
    vehicle.send(Kind.TELEMETRY, struct.pack("<I", 0))
    until(lambda: world.station.messages)
    assert world.station.starts == world.vehicle.starts == 1  # the same session continues


def test_link_with_a_new_source_port_is_accepted_again(world: World) -> None:
    station, vehicle = world.expect(), world.connect()
    until(lambda: up(station) and up(vehicle))
    before = {link.remote for link in station.links}
    world.relay.rebind()
    until(lambda: up(station, 0) and up(vehicle, 0))
    until(lambda: up(station) and up(vehicle))
    assert not before & {link.remote for link in station.links}
    station.send(Kind.COMMAND, struct.pack("<I", 0))
    until(lambda: world.vehicle.messages)


def test_link_without_its_address_is_retried(world: World) -> None:
    vehicle = world.connect(links=[A, Link("gone", "192.0.2.77"), Link("none", "nodev0")])
    station = world.expect()
    until(lambda: up(vehicle, 1) and up(station, 1))
    why = {link.name: link.why for link in vehicle.links}
    assert "192.0.2.77" in why["gone"] and "nodev0" in why["none"] and not why["a"]


def test_keys_are_renewed_during_traffic_without_loss(world: World) -> None:
    world.relay.shapes["127.0.0.1"].delay = 0.03
    station, vehicle = world.expect(), world.connect(renew=0.8)
    until(lambda: up(station) and up(vehicle))
    talks = Talk(station, rate=100), Talk(vehicle, Kind.TELEMETRY, rate=100)
    until(lambda: all(link.renewed >= 3 for link in vehicle.links), 20)
    down, back = (talk.stop() for talk in talks)
    until(lambda: len(world.vehicle.messages) == down and len(world.station.messages) == back)
    assert sorted(world.vehicle.numbers()) == list(range(down)) and sorted(world.station.numbers()) == list(range(back))
    until(lambda: len(world.listener._sessions) <= 2 * (2 + 3 / 0.8) + 2)


def test_restarted_station_is_found_and_begins_a_new_session(world: World) -> None:
    station, vehicle = world.expect(), world.connect()
    until(lambda: up(station) and up(vehicle) and world.vehicle.starts == 1)
    for number in range(20):
        station.send(Kind.COMMAND, struct.pack("<I", number))
    until(lambda: len(world.vehicle.messages) == 20)
    port = world.listener.port
    for host in ("127.0.0.1", "127.0.0.2"):  # no close message gets through, as after a power failure
        world.relay.shapes[host].cut = True
    world.listener.close()
    for host in ("127.0.0.1", "127.0.0.2"):
        world.relay.shapes[host].cut = False
    world.listener = Listener(DESK, [("127.0.0.1", port)])
    again = world.expect()
    until(lambda: up(again) and up(vehicle) and world.vehicle.starts == 2)
    again.send(Kind.COMMAND, struct.pack("<I", 77))  # number 0 of its session
    until(lambda: world.vehicle.numbers()[-1] == 77)
    assert world.vehicle.messages[-1].number == 0


def test_restarted_vehicle_replaces_its_old_connection(world: World) -> None:
    station, first = world.expect(), world.connect()
    until(lambda: up(station) and world.station.starts == 1)
    first.close()
    until(lambda: up(station, 0))
    later = MessageRecorder()
    second = world.connect(recorder=later)
    until(lambda: up(station) and up(second) and world.station.starts == 2)
    station.send(Kind.COMMAND, struct.pack("<I", 1))
    until(lambda: later.messages)
    assert not world.vehicle.messages


def test_clock_offset_is_measured_and_a_wrong_wall_clock_detected(world: World) -> None:
    world.relay.shapes["127.0.0.1"].delay = world.relay.shapes["127.0.0.2"].delay = 0.02
    world.relay.shapes["127.0.0.1"].jitter = 0.03
    ahead = ClockSync(lambda: time.monotonic_ns() + 5_000_000_000_000, lambda: time.time_ns() + 10_000_000_000)
    station, vehicle = world.expect(clocks=ahead), world.connect()
    assert not vehicle.clocks.known
    until(lambda: up(station) and up(vehicle) and station.clocks.known and vehicle.clocks.known)
    time.sleep(1)
    for one, offset, wall in ((vehicle.clocks, 5000, 10), (station.clocks, -5000, -10)):
        assert abs(one.offset - offset) * 1e3 <= one.uncertainty_ms < 100
        assert one.wall_wrong and one.wall_apart_s == pytest.approx(wall, abs=0.2)
    station.send(Kind.COMMAND, struct.pack("<I", 1))
    until(lambda: world.vehicle.messages)
    assert 0 < vehicle.clocks.age_ms(world.vehicle.messages[0].sent) < 5000


def test_video_is_copied_over_all_links_or_shared_between_them(world: World) -> None:
    station, vehicle = world.expect(), world.connect()
    until(lambda: up(station) and up(vehicle))
    packet = b"\x80" + bytes(999)
    for _ in range(100):
        vehicle.send_media(packet, Policy.COPY)
        vehicle.send_media(b"\x90" + packet[1:], Policy.SHARE)
    until(lambda: len(world.station.packets) == 300)
    by_link = {link: [one[0] for one, name in world.station.packets if name == link] for link in ("a", "b")}
    assert by_link["a"].count(0x80) == by_link["b"].count(0x80) == 100
    assert by_link["a"].count(0x90) + by_link["b"].count(0x90) == 100 and 40 <= by_link["a"].count(0x90) <= 60


def test_lossy_link_gets_a_smaller_share(world: World) -> None:
    world.relay.shapes["127.0.0.2"].loss = 0.2
    station, vehicle = world.expect(), world.connect()
    until(lambda: up(station) and up(vehicle))
    talk = Talk(vehicle, Kind.TELEMETRY, rate=100)
    time.sleep(3)
    before = {link.name: link.bytes_out for link in vehicle.links}
    for _ in range(400):
        vehicle.send_media(b"\x80" + bytes(999), Policy.SHARE)
        time.sleep(0.001)
    talk.stop()
    sent_bytes = {link.name: link.bytes_out - before[link.name] for link in vehicle.links}
    assert sent_bytes["b"] < 0.6 * sent_bytes["a"]


INTRUDERS = {
    "expired": identity(Role.VEHICLE, "car", days=-1),
    "another authority": identity(Role.VEHICLE, "car", authority=OTHER, trusts=OWN),
    "another name": identity(Role.VEHICLE, "van"),
    "another certificate of that name": identity(Role.VEHICLE, "car"),
    "a station's": identity(Role.STATION, "car"),
}


@pytest.mark.parametrize("party", INTRUDERS.values(), ids=INTRUDERS)
def test_unexpected_vehicle_is_refused(world: World, party: Identity) -> None:
    station = world.expect()
    vehicle = world.connect(party)
    until(lambda: world.listener.counts.get("refused", 0) >= 3)
    assert not station.links and not world.station.starts and not world.vehicle.starts and up(vehicle, 0)
    assert all(link.why for link in vehicle.links)
    mine = MessageRecorder()
    good = world.connect(recorder=mine)
    until(lambda: up(good) and up(station))


FALSE = {
    "expired": identity(Role.STATION, "desk", days=-1),
    "another authority": identity(Role.STATION, "desk", authority=OTHER, trusts=OWN),
    "another station": identity(Role.STATION, "chair"),
    "a vehicle's": identity(Role.VEHICLE, "desk"),
}


@pytest.mark.parametrize("party", FALSE.values(), ids=FALSE)
def test_vehicle_refuses_any_other_station(world: World, party: Identity) -> None:
    world.listener.close()
    port = world.listener.port
    world.listener = Listener(party, [("127.0.0.1", port)])
    false, vehicle = world.expect(), world.connect()
    until(lambda: all("certificate" in link.why or "not expected" in link.why for link in vehicle.links))
    false.send(Kind.COMMAND, b"drive")
    assert not world.vehicle.messages and not world.vehicle.starts and up(vehicle, 0)


def test_client_without_certificate_is_refused(world: World) -> None:
    from OpenSSL import SSL

    station = world.expect()
    context = SSL.Context(SSL.DTLS_METHOD)
    context.set_verify(SSL.VERIFY_NONE, lambda *_: True)
    client = SSL.Connection(context)
    client.set_connect_state()
    client.set_ciphertext_mtu(1200)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect(("127.0.0.1", world.listener.port))
        sock.settimeout(1)
        with pytest.raises(SSL.Error, match="alert"):
            for _ in range(20):
                try:
                    client.do_handshake()
                except SSL.WantReadError:
                    pass
                try:
                    sock.send(client.bio_read(9000))
                except SSL.WantReadError:
                    pass
                client.bio_write(sock.recv(9000))
    until(lambda: world.listener.counts.get("refused") == 1)
    assert not station.links


def memory() -> int:
    """Allocated bytes, without messages that the tests keep."""
    gc.collect()
    held = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(False, "*/messages.py")])
    return sum(one.size for one in held.traces)


@pytest.fixture
def long_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Longer timeouts of links, since a machine that runs tests is busy."""
    monkeypatch.setattr(multipath, "RECEIVE_TIMEOUT_S", 5.0)
    monkeypatch.setattr(multipath, "PONG_TIMEOUT_S", 10.0)


def attack(world: World, count: int) -> None:
    """Send malformed, forged and replayed datagrams, from strangers and from the joined pair's own addresses."""
    chance = random.Random(4)
    station = world.expect(media=lambda packet, link: None)  # packets that aren't SRTP are rejected by SRTP
    world.relay.recording = True
    vehicle = world.connect()
    until(lambda: up(station) and up(vehicle))
    talks = Talk(station), Talk(vehicle, Kind.TELEMETRY)
    until(lambda: len(world.relay.recorded) > 200)
    world.relay.recording = False
    recorded_packets = [data for _, data in world.relay.recorded]
    assert any(map(is_hello, recorded_packets))
    tracemalloc.start()
    strangers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(8)]
    joined = list(world.relay._out.values())  # sockets with the addresses of the vehicle's links
    memory_before = 0
    far = ("127.0.0.1", world.listener.port)
    for number in range(count):
        data = bytearray(chance.choice(recorded_packets))
        if number % 3 == 1:
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        elif number % 3 == 2:
            data = bytearray(chance.randbytes(chance.randrange(0, 2100)))
        chance.choice(strangers if number % 2 else joined).sendto(data, far)
        if number % 20 == 0:
            time.sleep(0.004)
        if number == count // 2:
            memory_before = memory()
    time.sleep(0.2)
    memory_growth = memory() - memory_before
    tracemalloc.stop()
    for sock in strangers:
        sock.close()
    assert up(station) and up(vehicle)
    down, back = (talk.stop() for talk in talks)
    until(lambda: len(world.vehicle.messages) == down and len(world.station.messages) == back)
    assert world.vehicle.numbers() == list(range(down)) and world.station.numbers() == list(range(back))
    assert station.counts["replayed"] > 0 and station.counts["malformed"] > 0
    assert world.listener.counts["strangers"] > 0
    assert world.station.starts == world.vehicle.starts == 1
    assert (
        memory_growth < 2_000_000
        and len(world.listener._sessions) < 64
        and len(world.listener._hosts) <= station_side.TRACKED_HOSTS_MAX
    )


def test_malformed_and_replayed_datagrams_have_no_effect(world: World, long_timeouts: None) -> None:
    attack(world, 5_000)


@pytest.mark.slow
def test_a_hundred_thousand_malformed_datagrams_have_no_effect(world: World, long_timeouts: None) -> None:
    attack(world, 100_000)


def test_malformed_client_hello_does_not_block_others(world: World) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for false in (b"\x01" + b"\xff" * 60, b"\x01\0\0\x40" + bytes(60), b"\x01" + os.urandom(400)):
            head = b"\x16\xfe\xfd" + bytes(8) + len(false).to_bytes(2, "big")
            sock.sendto(head + false, ("127.0.0.1", world.listener.port))
    until(lambda: world.listener.counts.get("malformed", 0) == 3)
    station, vehicle = world.expect(), world.connect()
    until(lambda: up(station) and up(vehicle))


def test_flood_of_ten_times_the_rate_does_not_disturb_the_joined_pair(world: World, long_timeouts: None) -> None:
    world.relay.recording = True
    station, vehicle = world.expect(), world.connect()
    until(lambda: up(station) and up(vehicle))
    hello = next(data for _, data in world.relay.recorded if is_hello(data))
    talks = Talk(station), Talk(vehicle, Kind.TELEMETRY)
    ends = threading.Event()
    sent = [0]

    def flood() -> None:
        socks = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(4)]
        for host, sock in enumerate(socks):
            sock.bind((f"127.0.1.{host}", 0))
        kinds = (hello, os.urandom(1000), b"\x80" + bytes(1199), hello[:50])
        while not ends.is_set():
            for number in range(20):
                socks[number % 4].sendto(kinds[number % 3], ("127.0.0.1", world.listener.port))
            sent[0] += 20
            time.sleep(20 / 12_000)

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        time.sleep(2)
        assert up(station) and up(vehicle)
        down, back = (talk.stop() for talk in talks)
        until(lambda: len(world.vehicle.messages) == down and len(world.station.messages) == back)
    finally:
        ends.set()
        thread.join()
    assert sent[0] > 2000 and world.listener.counts["flooded"] > 0
    assert world.vehicle.numbers() == list(range(down)) and world.station.numbers() == list(range(back))


def test_handshake_over_a_mobile_link_takes_less_than_two_seconds(world: World) -> None:
    for host in ("127.0.0.1", "127.0.0.2"):
        world.relay.shapes[host].delay, world.relay.shapes[host].jitter = 0.04, 0.01
        world.relay.shapes[host].loss = 0.01
    station, started = world.expect(), time.monotonic()
    vehicle = world.connect()
    until(lambda: up(vehicle, 2) and up(station, 2))
    assert time.monotonic() - started < 5 and min(link.handshake_s for link in vehicle.links) < 2


def test_forgotten_vehicle_is_refused_until_expected_again(world: World) -> None:
    station, vehicle = world.expect(), world.connect()
    until(lambda: up(station) and up(vehicle))
    world.listener.forget(CAR.me)
    until(lambda: up(vehicle, 0))
    until(lambda: world.listener.counts.get("refused", 0))
    assert not world.listener._expected
    world.expect()
    until(lambda: up(vehicle))


def test_failing_message_callback_does_not_end_the_connection(world: World) -> None:
    recorder: list[Message] = []

    def faulty(message: Message) -> None:
        recorder.append(message)
        raise RuntimeError("a fault")

    station = world.listener.expect(CAR.me, faulty)
    vehicle = world.connect()
    until(lambda: up(station))
    for _ in range(3):
        vehicle.send(Kind.TELEMETRY, b"")
    until(lambda: len(recorder) == 3)
    until(lambda: station.counts.get("failed") == 3)
    assert up(station)


def test_invalid_addresses_are_reported(world: World) -> None:
    for links, addresses in (([], [("127.0.0.1", 1)]), ([A], []), ([A] * 20, [("127.0.0.1", 1)]), ([A], [("host", 1)])):
        with pytest.raises(SettingError):
            connect_station(CAR, DESK.me, links, addresses, received=lambda message: None)
    with pytest.raises(BusyError):
        Listener(DESK, [("127.0.0.1", world.listener.port)])
    with pytest.raises(SettingError):
        Listener(DESK, [("192.0.2.1", 0)])
    vehicle = world.connect()
    with pytest.raises(ValueError, match="a message body of"):
        vehicle.send(Kind.TELEMETRY, bytes(2000))


def test_dtls_datagrams_are_recognized_by_their_records() -> None:
    record = b"\x17\xfe\xfd" + bytes(8) + b"\0\x05hello"
    assert count_records(record) == 1 and count_records(record * 3) == 3
    for wrong in (
        b"",
        b"\x17",
        record[:-1],
        record + b"x",
        b"\x80" + record[1:],
        b"\x17\x03\x03" + record[3:],
        record * 200,
    ):
        assert count_records(wrong) == 0
    assert not is_hello(record)
