"""A vehicle and a station over links that are cut, slow, lossy and attacked, in virtual time."""

from __future__ import annotations

import gc
import os
import random
import struct
import tracemalloc
from typing import Any

import pytest
from OpenSSL import SSL

from scan2sim.services.teleoperation.control.messages import Kind, Message
from scan2sim.services.teleoperation.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.transport import station_side
from scan2sim.services.teleoperation.transport.clock_sync import ClockSync
from scan2sim.services.teleoperation.transport.dtls_session import count_records, is_hello
from scan2sim.services.teleoperation.transport.multipath import (
    PONG_TIMEOUT_S,
    RECEIVE_TIMEOUT_S,
    MultipathConnection,
    Policy,
)
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.udp_reactor import TICK_S
from scan2sim.services.teleoperation.transport.vehicle_side import (
    RECONNECT_PERIOD_S,
    REPLACED_SESSION_LIFETIME_S,
    Link,
    connect_station,
)
from tests.fakes.certificates import OTHER, OWN, identity
from tests.fakes.simulated_network import Machine, SimulatedNetwork, without_retransmission

CAR, DESK = identity(Role.VEHICLE, "car"), identity(Role.STATION, "desk")
HOST_A, HOST_B, STATION = "10.0.0.1", "10.0.1.1", "192.0.2.1"
A, B = Link("a", HOST_A), Link("b", HOST_B)


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

    def __init__(self, seed: int = 1) -> None:
        self.network = SimulatedNetwork(seed)
        self.office, self.car = self.network.machine(STATION), self.network.machine(HOST_A, HOST_B)
        self.a, self.b = self.network.path(HOST_A), self.network.path(HOST_B)
        self.until, self.run = self.network.until, self.network.run
        self.listener = self.listen()
        self.station, self.vehicle = MessageRecorder(), MessageRecorder()

    def listen(self, party: Identity = DESK, port: int = 0) -> Listener:
        return Listener(party, [(STATION, port)], clock=self.network.clock, reactor=self.office.reactor)

    def clocks(self, ahead: float = 0, wall_ahead: float = 0) -> ClockSync:
        """Clocks of a machine, seconds ahead of the network's."""
        now, wall = self.network.clock, 1.7e9 + wall_ahead
        return ClockSync(lambda: round((now() + ahead) * 1e9), lambda: round((now() + wall) * 1e9))

    def expect(self, peer: Peer = CAR.me, **more: Any) -> MultipathConnection:
        return self.listener.expect(peer, **(self.station.callbacks | {"clocks": self.clocks()} | more))

    def connect(
        self, party: Identity = CAR, peer: Peer = DESK.me, recorder: MessageRecorder | None = None, **more: Any
    ) -> MultipathConnection:
        return connect_station(
            party, peer, more.pop("links", [A, B]), [self.listener.addresses[0]],
            **(recorder or self.vehicle).callbacks, **({"clocks": self.clocks()} | more),
            clock=self.network.clock, reactor=self.car.reactor,
        )  # fmt: skip

    def join(self, **more: Any) -> tuple[MultipathConnection, MultipathConnection]:
        """Connect, and wait until both links are up; returns station and vehicle."""
        station, vehicle = self.expect(), self.connect(**more)
        self.until(lambda: up(station) and up(vehicle) and self.station.starts and self.vehicle.starts)
        return station, vehicle


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    without_retransmission(monkeypatch)
    return World()


def up(connection: MultipathConnection, count: int = 2) -> bool:
    return sum(link.up for link in connection.links) == count


class Talk:
    """Sends numbered messages at a rate until stopped; on a machine, or, while this stalls, in another thread of it."""

    def __init__(
        self, at: Machine | SimulatedNetwork, connection: MultipathConnection, kind: Kind = Kind.COMMAND,
        rate: float = 50,
    ) -> None:  # fmt: skip
        self._connection, self._kind = connection, kind
        self.sent = 0
        self._end = at.every(1 / rate, self._send)

    def _send(self) -> None:
        self._connection.send(self._kind, struct.pack("<I", self.sent))
        self.sent += 1

    def stop(self) -> int:
        self._end()
        return self.sent


class Talks:
    """Traffic in both directions, and what must have arrived at its end."""

    def __init__(
        self, world: World, station: MultipathConnection, vehicle: MultipathConnection, rate: float = 50,
        stalling: bool = True,
    ) -> None:  # fmt: skip
        self._world = world
        self._down = Talk(world.office if stalling else world.network, station, rate=rate)
        self._back = Talk(world.car if stalling else world.network, vehicle, Kind.TELEMETRY, rate)

    def stop(self) -> tuple[int, int]:
        """Stop, and let everything arrive; each message must have arrived once. Returns how many were sent."""
        down, back = self._down.stop(), self._back.stop()
        self._world.run(6)  # keys are renewed, and messages of replaced sessions arrive
        assert sorted(self._world.vehicle.numbers()) == list(range(down))
        assert sorted(self._world.station.numbers()) == list(range(back))
        return down, back


def test_messages_arrive_once_in_both_directions_over_two_links(world: World) -> None:
    world.a.delay, world.a.duplication, world.b.delay = 0.04, 0.3, 0.04
    station, vehicle = world.join()
    assert world.station.starts == world.vehicle.starts == 1
    talks = Talks(world, station, vehicle, rate=200)
    world.run(1)
    down, back = talks.stop()
    assert down == back == 201
    assert world.vehicle.numbers() == list(range(down)) and world.station.numbers() == list(range(back))
    assert vehicle.counts["duplicates"] == down and station.counts["duplicates"] == back
    assert vehicle.counts["replayed"] + station.counts["replayed"] == world.a.duplicated > 100
    assert {link.name for link in station.links} == {link.name for link in vehicle.links} == {"a", "b"}
    for link in vehicle.links:
        assert link.handshake_s == pytest.approx(6 * 0.04)  # cookie, certificates, keys: three round trips
        assert link.round_trip_ms == pytest.approx(80) and link.loss == link.loss_there == 0
        assert link.bytes_in > 3000 and link.remote == f"{STATION}:{world.listener.port}"
        assert link.cipher == "DTLSv1.2 ECDHE-ECDSA-CHACHA20-POLY1305 x25519"


@pytest.mark.parametrize("seed", [16, 18, 19, 48, *range(4)])  # in the first four, messages overtake their first ping
def test_cutting_and_restoring_one_of_two_links_loses_and_duplicates_nothing(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    without_retransmission(monkeypatch)
    world, chance = World(seed), random.Random(seed)
    world.a.delay, world.a.jitter, world.b.delay, world.b.jitter = 0.02, 0.01, 0.02, 0.01
    station, vehicle = world.join()
    talks = Talks(world, station, vehicle, rate=170)
    for path in (world.a, world.b) * 2:
        path.cut = True
        world.until(lambda: up(station, 1) and up(vehicle, 1), RECEIVE_TIMEOUT_S + 0.03 + TICK_S)
        world.run(chance.uniform(0, 2))
        path.cut = False
        world.until(lambda: up(station) and up(vehicle), RECONNECT_PERIOD_S)
    talks.stop()


def test_messages_before_the_first_ping_of_a_session_are_received(world: World) -> None:
    station, vehicle = world.expect(), world.connect(links=[A])
    world.a.delay = 0.02
    world.until(lambda: up(vehicle, 1))
    world.network.drop(HOST_A)  # the ping
    vehicle.send(Kind.TELEMETRY, struct.pack("<I", 0))
    vehicle.send_media(b"\x80" + bytes(99))
    world.run(0.03)
    assert world.station.numbers() == [0] and not station.links and not world.station.packets
    world.until(lambda: up(station, 1), 0.1)  # the next ping names the link


@pytest.mark.parametrize("side", ["station", "vehicle", "both"])
@pytest.mark.parametrize("stalling", [True, False], ids=["all threads", "only the thread of the links"])
@pytest.mark.parametrize("seconds", [0.3, 1.0, 1.5, REPLACED_SESSION_LIFETIME_S - 0.1])
def test_stalls_lose_and_duplicate_nothing(world: World, side: str, stalling: bool, seconds: float) -> None:
    world.a.delay, world.a.jitter, world.b.delay, world.b.jitter = 0.02, 0.01, 0.03, 0.02
    station, vehicle = world.join()
    talks = Talks(world, station, vehicle, stalling=stalling)
    for pause in (0.31, 1.003, 0.52, 0.05, 2.0):
        for machine in (world.office,) * (side != "vehicle") + (world.car,) * (side != "station"):
            machine.stall(seconds)
        world.run(seconds + pause)
    world.until(lambda: up(station) and up(vehicle))
    talks.stop()
    assert world.station.starts == world.vehicle.starts == 1


def test_losses_of_one_link_are_compensated_by_the_other_and_measured(world: World) -> None:
    station, vehicle = world.join()
    world.b.loss = 0.3
    talks = Talks(world, station, vehicle, rate=100)
    world.run(30)
    for connection in (station, vehicle):
        for loss in ("loss", "loss_there"):
            measured = {link.name: getattr(link, loss) for link in connection.links}
            assert measured["a"] == 0 and measured["b"] == pytest.approx(0.3, abs=0.1)
    assert world.b.lost / (world.b.lost + world.b.carried) == pytest.approx(0.3, abs=0.02)
    talks.stop()


def test_both_links_cut_are_reported_and_recover(world: World) -> None:
    world.a.delay = world.b.delay = 0.02
    station, vehicle = world.join()
    world.a.cut = world.b.cut = True
    world.until(lambda: up(station, 0) and up(vehicle, 0), RECEIVE_TIMEOUT_S + 0.02 + TICK_S)
    assert all(link.why for link in vehicle.links)
    world.run(1.5)
    world.a.cut = world.b.cut = False
    world.until(lambda: up(station) and up(vehicle))
    vehicle.send(Kind.TELEMETRY, struct.pack("<I", 0))
    world.run(0.03)
    assert world.station.numbers() == [0]
    assert world.station.starts == world.vehicle.starts == 1  # the same session continues


def test_link_that_works_in_one_direction_counts_as_down(world: World) -> None:
    station, vehicle = world.join()
    world.a.cut_back = True
    world.until(lambda: up(vehicle, 1), RECEIVE_TIMEOUT_S + TICK_S)
    assert up(station)
    world.until(lambda: up(station, 1), PONG_TIMEOUT_S - RECEIVE_TIMEOUT_S + TICK_S)
    assert "nothing is received" in {link.name: link.why for link in vehicle.links}["a"]


def test_link_with_a_new_source_port_is_accepted_again(world: World) -> None:
    world.a.delay = world.b.delay = 0.02
    station, vehicle = world.join()
    before = {link.remote for link in station.links}
    for host in (HOST_A, HOST_B):
        world.network.rebind(host)
    # the station doesn't know the new ports: the vehicle must notice the silence, and connect again
    world.until(lambda: not before & {link.remote for link in station.links}, RECEIVE_TIMEOUT_S + 0.2)
    world.until(lambda: up(station) and up(vehicle), 0.2)
    station.send(Kind.COMMAND, struct.pack("<I", 0))
    world.run(0.03)
    assert world.vehicle.numbers() == [0] and world.vehicle.starts == 1


def test_link_without_its_address_is_retried(world: World) -> None:
    world.expect()
    vehicle = world.connect(links=[A, Link("b", "192.0.2.77")])
    world.until(lambda: up(vehicle, 1))
    world.run(1)
    why = {link.name: link.why for link in vehicle.links}
    assert "192.0.2.77" in why["b"] and not why["a"]
    world.car.hosts += ("192.0.2.77",)
    world.until(lambda: up(vehicle), RECONNECT_PERIOD_S + TICK_S)


def test_keys_are_renewed_during_traffic_without_loss(world: World) -> None:
    world.a.delay, world.b.delay, world.b.jitter = 0.03, 0.01, 0.02
    station, vehicle = world.join(renew=0.8)
    talks = Talks(world, station, vehicle, rate=100)
    world.until(lambda: all(link.renewed >= 10 for link in vehicle.links))
    talks.stop()
    assert len(world.listener._sessions) <= 2 * (2 + REPLACED_SESSION_LIFETIME_S / 0.8) + 2


def test_restarted_station_is_found_and_begins_a_new_session(world: World) -> None:
    station, vehicle = world.join()
    for number in range(20):
        station.send(Kind.COMMAND, struct.pack("<I", number))
    world.run(0.1)
    assert world.vehicle.numbers() == list(range(20)) and world.vehicle.starts == 1
    world.a.cut = world.b.cut = True  # no close message gets through, as after a power failure
    world.listener.close()
    world.a.cut = world.b.cut = False
    world.listener = world.listen(port=world.listener.port)
    again = world.expect()
    world.until(lambda: up(again) and up(vehicle) and world.vehicle.starts == 2)
    again.send(Kind.COMMAND, struct.pack("<I", 77))  # number 0 of its session
    world.run(0.1)
    assert world.vehicle.numbers() == [*range(20), 77] and world.vehicle.messages[-1].number == 0


def test_restarted_vehicle_replaces_its_old_connection(world: World) -> None:
    station, first = world.join()
    first.close()
    world.until(lambda: up(station, 0), 0.1)
    later = MessageRecorder()
    second = world.connect(recorder=later)
    world.until(lambda: up(station) and up(second) and world.station.starts == 2)
    station.send(Kind.COMMAND, struct.pack("<I", 1))
    world.run(0.1)
    assert later.numbers() == [1] and not world.vehicle.messages


def test_clock_offset_is_measured_and_a_wrong_wall_clock_detected(world: World) -> None:
    world.a.delay, world.a.jitter, world.b.delay = 0.02, 0.03, 0.02
    station, vehicle = world.expect(clocks=world.clocks(5000, 10)), world.connect()
    assert not vehicle.clocks.known
    world.until(lambda: station.clocks.known and vehicle.clocks.known)
    world.run(1)
    for one, offset, wall in ((vehicle.clocks, 5000, 10), (station.clocks, -5000, -10)):
        assert abs(one.offset - offset) * 1e3 <= one.uncertainty_ms < 21
        assert one.wall_wrong and one.wall_apart_s == pytest.approx(wall, abs=0.021)
    station.send(Kind.COMMAND, struct.pack("<I", 1))
    world.until(lambda: world.vehicle.messages)
    assert vehicle.clocks.age_ms(world.vehicle.messages[0].sent) == pytest.approx(20, abs=vehicle.clocks.uncertainty_ms)


def test_video_is_copied_over_all_links_or_shared_between_them(world: World) -> None:
    _, vehicle = world.join()
    packet = b"\x80" + bytes(999)
    for _ in range(100):
        vehicle.send_media(packet, Policy.COPY)
        vehicle.send_media(b"\x90" + packet[1:], Policy.SHARE)
    world.run(0.01)
    by_link = {link: [one[0] for one, name in world.station.packets if name == link] for link in ("a", "b")}
    assert by_link["a"].count(0x80) == by_link["b"].count(0x80) == 100
    assert by_link["a"].count(0x90) == by_link["b"].count(0x90) == 50 and len(world.station.packets) == 300


def test_lossy_link_gets_a_smaller_share(world: World) -> None:
    _, vehicle = world.join()
    world.b.loss = 0.2
    Talk(world.car, vehicle, Kind.TELEMETRY, rate=100)
    world.run(3)
    before = {link.name: link.bytes_out for link in vehicle.links}
    for _ in range(400):
        vehicle.send_media(b"\x80" + bytes(999), Policy.SHARE)
        world.run(0.001)
    sent_bytes = {link.name: link.bytes_out - before[link.name] for link in vehicle.links}
    assert sent_bytes["b"] < 0.2 * sent_bytes["a"]


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
    world.until(lambda: world.listener.counts.get("rejected", 0) >= 3)
    assert not station.links and not world.station.starts and not world.vehicle.starts and up(vehicle, 0)
    assert all(link.why for link in vehicle.links)
    good = world.connect(recorder=MessageRecorder())
    world.until(lambda: up(good) and up(station))


FALSE = {
    "expired": identity(Role.STATION, "desk", days=-1),
    "another authority": identity(Role.STATION, "desk", authority=OTHER, trusts=OWN),
    "another station": identity(Role.STATION, "chair"),
    "a vehicle's": identity(Role.VEHICLE, "desk"),
}


@pytest.mark.parametrize("party", FALSE.values(), ids=FALSE)
def test_vehicle_refuses_any_other_station(world: World, party: Identity) -> None:
    world.listener.close()
    world.listener = world.listen(party)
    false, vehicle = world.expect(), world.connect()
    world.until(lambda: all("certificate" in link.why or "not expected" in link.why for link in vehicle.links))
    false.send(Kind.COMMAND, b"drive")
    world.run(1)
    assert not world.vehicle.messages and not world.vehicle.starts and up(vehicle, 0)


def test_client_without_certificate_is_refused(world: World) -> None:
    station = world.expect()
    context = SSL.Context(SSL.DTLS_METHOD)
    context.set_verify(SSL.VERIFY_NONE, lambda *_: True)
    client = SSL.Connection(context)
    client.set_connect_state()
    client.set_ciphertext_mtu(1200)

    def receive(sock: object, data: bytes, source: object) -> None:
        client.bio_write(data)

    reactor = world.car.reactor(receive, lambda now: None, world.network.clock)
    sock = reactor.connect(HOST_A, world.listener.addresses[0])
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
            world.run(0.01)
    assert world.listener.counts["rejected"] == 1 and not station.links


def memory() -> int:
    """Allocated bytes, without messages that the tests keep."""
    gc.collect()
    held = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(False, "*/messages.py")])
    return sum(one.size for one in held.traces)


def attack(world: World, count: int) -> None:
    """Send malformed, forged and replayed datagrams, from strangers and from the joined pair's own addresses."""
    chance = random.Random(4)
    station = world.expect(media=lambda packet, link: None)  # packets that aren't SRTP are rejected by SRTP
    world.network.recording = True
    vehicle = world.connect()
    world.until(lambda: up(station) and up(vehicle))
    talks = Talks(world, station, vehicle)
    world.until(lambda: len(world.network.recorded) > 400)
    world.network.recording = False
    far = world.listener.addresses[0]
    recorded = [(source, data) for source, data in world.network.recorded if source != far]
    assert any(is_hello(data) for _, data in recorded)
    strangers = [(f"203.0.113.{number}", 5000) for number in range(8)]
    joined = sorted({source for source, _ in recorded})
    assert len(joined) == 2
    tracemalloc.start()
    memory_before = 0
    for number in range(count):
        data = bytearray(chance.choice(recorded)[1])
        if number % 3 == 1:
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        elif number % 3 == 2:
            data = bytearray(chance.randbytes(chance.randrange(0, 2100)))
        world.network.send(chance.choice(strangers if number % 2 else joined), far, bytes(data))
        world.run(0.0002)
        assert up(station) and up(vehicle)
        if number == count // 2:
            memory_before = memory()
    memory_growth = memory() - memory_before
    tracemalloc.stop()
    talks.stop()
    assert station.counts["replayed"] > 0 and station.counts["malformed"] > 0
    assert world.listener.counts["unknown_senders"] > 0
    assert world.station.starts == world.vehicle.starts == 1
    assert (
        memory_growth < 2_000_000
        and len(world.listener._sessions) < 64
        and len(world.listener._hosts) <= station_side.TRACKED_HOSTS_MAX
    )


def test_malformed_and_replayed_datagrams_have_no_effect(world: World) -> None:
    attack(world, 5_000)


@pytest.mark.slow
def test_a_hundred_thousand_malformed_datagrams_have_no_effect(world: World) -> None:
    attack(world, 100_000)


def test_malformed_client_hello_does_not_block_others(world: World) -> None:
    for false in (b"\x01" + b"\xff" * 60, b"\x01\0\0\x40" + bytes(60), b"\x01" + os.urandom(400)):
        head = b"\x16\xfe\xfd" + bytes(8) + len(false).to_bytes(2, "big")
        world.network.send(("203.0.113.1", 5000), world.listener.addresses[0], head + false)
    world.run(0.1)
    assert world.listener.counts["malformed"] == 3
    world.join()


def test_flood_of_ten_times_the_rate_does_not_disturb_the_joined_pair(world: World) -> None:
    world.network.recording = True
    station, vehicle = world.join()
    hello = next(data for _, data in world.network.recorded if is_hello(data))
    world.network.recording = False
    talks = Talks(world, station, vehicle)
    kinds, sent, far = (hello, os.urandom(1000), b"\x80" + bytes(1199)), [0], world.listener.addresses[0]

    def flood() -> None:
        assert up(station) and up(vehicle)
        for number in range(20):
            world.network.send((f"203.0.113.{number % 4}", 5000), far, kinds[number % 3])
        sent[0] += 20

    end = world.network.every(20 / 12_000, flood)
    world.run(2)
    end()
    talks.stop()
    counts = world.listener.counts
    answered = 4 * 3 * station_side.HELLO_RATE_PER_HOST_MAX  # a burst of one second, then two seconds at the rate
    hellos = -(-sent[0] // 20) * 7
    assert counts["unknown_senders"] == sent[0] - hellos
    assert counts["flooded"] == pytest.approx(hellos - answered, abs=8)


def test_forgotten_vehicle_is_refused_until_expected_again(world: World) -> None:
    _, vehicle = world.join()
    world.listener.forget(CAR.me)
    world.until(lambda: up(vehicle, 0), 0.1)
    world.until(lambda: world.listener.counts.get("rejected", 0), RECONNECT_PERIOD_S + 0.1)
    assert not world.listener._expected
    world.expect()
    world.until(lambda: up(vehicle), RECONNECT_PERIOD_S + 0.1)


def test_failing_message_callback_does_not_end_the_connection(world: World) -> None:
    recorder: list[Message] = []

    def faulty(message: Message) -> None:
        recorder.append(message)
        raise RuntimeError("a fault")

    station = world.expect(received=faulty)
    vehicle = world.connect()
    world.until(lambda: up(station) and up(vehicle))
    for _ in range(3):
        vehicle.send(Kind.TELEMETRY, b"")
    world.run(0.1)
    assert len(recorder) == station.counts["failed"] == 3 and up(station)


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
