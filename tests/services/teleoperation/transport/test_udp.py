"""Both sides of a multipath connection over real UDP sockets; `test_multipath` has the rest, in virtual time."""

from __future__ import annotations

import random
import socket
import struct
from collections.abc import Callable, Iterator
from functools import partial

import pytest

from scan2sim.pipeline.core.errors import BusyError, SettingError
from scan2sim.services.teleoperation.control.messages import Kind, Message
from scan2sim.services.teleoperation.identity import Role
from scan2sim.services.teleoperation.transport.multipath import MultipathConnection
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.udp_reactor import UdpReactor
from scan2sim.services.teleoperation.transport.vehicle_side import Link, connect_station
from tests.fakes.certificates import identity
from tests.fakes.relay import Relay
from tests.waiting import until

CAR, DESK = identity(Role.VEHICLE, "car"), identity(Role.STATION, "desk")
HOSTS = ("127.0.0.1", "127.0.0.2")
LINKS = [Link(name, host) for name, host in zip("ab", HOSTS, strict=True)]


class World:
    """A station, a vehicle, and a relay between them."""

    def __init__(self) -> None:
        self.listener = Listener(DESK, [("127.0.0.1", 0)])
        self.relay = Relay(("127.0.0.1", self.listener.port))
        self.at_station: list[int] = []
        self.at_vehicle: list[int] = []
        self.ends: list[Callable[[], None]] = [self.relay.close, self.listener.close]

    def join(self) -> tuple[MultipathConnection, MultipathConnection]:
        """Connect, and wait until both links are up; returns station and vehicle."""
        station = self.listener.expect(CAR.me, partial(_record, self.at_station))
        received = partial(_record, self.at_vehicle)
        vehicle = connect_station(CAR, DESK.me, LINKS, [self.relay.address], received=received)
        self.ends.insert(0, vehicle.close)
        until(lambda: _up(station) == _up(vehicle) == 2)
        return station, vehicle

    def exchange(self, station: MultipathConnection, vehicle: MultipathConnection, count: int) -> None:
        """Send messages in both directions, each after the previous one arrived; each must arrive once."""
        first = len(self.at_vehicle)
        for number in range(first, first + count):
            station.send(Kind.COMMAND, struct.pack("<I", number))
            vehicle.send(Kind.TELEMETRY, struct.pack("<I", number))
            until(partial(self._have, number + 1))
        assert self.at_vehicle == self.at_station == list(range(first + count))

    def _have(self, count: int) -> bool:
        return len(self.at_vehicle) >= count and len(self.at_station) >= count


def _record(numbers: list[int], message: Message) -> None:
    numbers.append(struct.unpack("<I", message.body)[0])


def _up(connection: MultipathConnection) -> int:
    return sum(link.up for link in connection.links)


@pytest.fixture
def world() -> Iterator[World]:
    made = World()
    yield made
    for end in made.ends:
        end()


def test_messages_arrive_once_in_both_directions(world: World) -> None:
    for host in HOSTS:
        world.relay.shapes[host].delay, world.relay.shapes[host].duplication = 0.01, 0.3
    station, vehicle = world.join()
    world.exchange(station, vehicle, 30)
    until(lambda: station.counts.get("duplicates") and vehicle.counts.get("duplicates"))  # both links carry them
    assert {link.name for link in station.links} == {link.name for link in vehicle.links} == {"a", "b"}


def test_lost_handshake_datagrams_are_retransmitted(world: World) -> None:
    for host in HOSTS:
        world.relay.shapes[host].delay, world.relay.shapes[host].jitter = 0.04, 0.01
        world.relay.shapes[host].loss = 0.1
    _, vehicle = world.join()
    assert all(link.handshake_s >= 3 * 0.08 for link in vehicle.links)


def test_link_with_a_new_source_port_is_accepted_again(world: World) -> None:
    station, vehicle = world.join()
    before = {link.remote for link in station.links}
    world.relay.rebind()
    until(lambda: not before & {link.remote for link in station.links})
    until(lambda: _up(station) == _up(vehicle) == 2)
    world.exchange(station, vehicle, 3)


def test_hostile_datagrams_have_no_effect(world: World) -> None:
    chance = random.Random(4)
    world.relay.recording = True
    station, vehicle = world.join()
    world.exchange(station, vehicle, 10)
    world.relay.recording = False
    recorded = [data for _, data in world.relay.recorded]
    joined = list(world.relay._out.values())  # sockets with the addresses of the vehicle's links
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for number in range(500):
            data = bytearray(chance.choice(recorded))
            if number % 3 == 1:
                data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
            elif number % 3 == 2:
                data = bytearray(chance.randbytes(chance.randrange(0, 2100)))
            sock = stranger if number % 2 else chance.choice(joined)
            sock.sendto(data, ("127.0.0.1", world.listener.port))
        until(lambda: world.listener.counts.get("unknown_senders", 0) > 0)
    until(lambda: station.counts.get("replayed", 0) > 0 and station.counts.get("malformed", 0) > 0)
    world.exchange(station, vehicle, 3)


def test_sockets_need_an_address_of_this_machine(world: World) -> None:
    reactor = UdpReactor(lambda sock, data, address: None, lambda now: None)
    for local in ("192.0.2.77", "nodev0"):
        with pytest.raises(OSError):
            reactor.connect(local, ("127.0.0.1", world.listener.port))
    reactor.start()
    reactor.end()


def test_invalid_addresses_are_reported(world: World) -> None:
    received, anywhere = partial(_record, world.at_vehicle), [("127.0.0.1", 1)]
    for links, addresses in (([], anywhere), (LINKS, []), (LINKS * 10, anywhere), (LINKS, [("host", 1)])):
        with pytest.raises(SettingError):
            connect_station(CAR, DESK.me, links, addresses, received=received)
    with pytest.raises(BusyError):
        Listener(DESK, [("127.0.0.1", world.listener.port)])
    with pytest.raises(SettingError):
        Listener(DESK, [("192.0.2.1", 0)])
    vehicle = connect_station(CAR, DESK.me, LINKS, [world.relay.address], received=received)
    world.ends.insert(0, vehicle.close)
    with pytest.raises(ValueError, match="a message body of"):
        vehicle.send(Kind.TELEMETRY, bytes(2000))
