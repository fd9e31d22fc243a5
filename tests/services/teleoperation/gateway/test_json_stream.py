"""Connections of the gateway: authentication, malformed lines, slow readers and restarts."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
from OpenSSL import SSL

from scan2sim.services.teleoperation.gateway import json_stream
from scan2sim.services.teleoperation.gateway.json_stream import Client, Connection, Server
from scan2sim.services.teleoperation.identity import Identity, Role
from scan2sim.services.teleoperation.transport import tls
from scan2sim.services.teleoperation.transport.tls import Channel, TlsError
from tests.fakes.certificates import OTHER, OWN, identity
from tests.waiting import until


class Clock:
    """A clock that the test sets; it is constant otherwise, so that nothing times out on a slow machine."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class Side:
    """Records the callbacks of one side, and has its clock."""

    def __init__(self) -> None:
        self.connections: list[Connection] = []
        self.lines: list[Any] = []
        self.ends: list[str] = []
        self.clock = Clock()

    def opened(self, connection: Connection) -> None:
        self.connections.append(connection)

    def received(self, connection: Connection, message: Any) -> None:
        self.lines.append(message)

    def closed(self, *arguments: Any) -> None:
        self.ends.append(str(arguments[-1]))

    @property
    def callbacks(self) -> dict[str, Any]:
        return {"opened": self.opened, "received": self.received, "closed": self.closed, "clock": self.clock}

    def advance(self, thread: Client | Server, seconds: float) -> None:
        """Let time pass for this side."""
        self.clock.now += seconds
        thread.wake()


@pytest.fixture
def gateway() -> Iterator[tuple[Server, Side]]:
    side = Side()
    server = Server(identity(Role.GATEWAY), "127.0.0.1", 0, **side.callbacks)
    yield server, side
    server.close()


@pytest.fixture
def connect(gateway: tuple[Server, Side]) -> Iterator[Callable[..., tuple[Client, Side]]]:
    clients: list[Client] = []

    def client(party: Identity, host: str = "127.0.0.1", clock: Clock | None = None) -> tuple[Client, Side]:
        side = Side()
        side.clock = clock or side.clock
        clients.append(Client(party, host, gateway[0].port, **side.callbacks))
        return clients[-1], side

    yield client
    for one in clients:
        one.close()


def test_lines_go_both_ways_and_the_gateway_knows_the_sender(gateway: Any, connect: Any) -> None:
    car = identity(Role.VEHICLE, "car")
    client, mine = connect(car)
    until(lambda: client.connected)
    theirs = gateway[1]
    until(lambda: theirs.connections)
    assert theirs.connections[0].peer == car.me and mine.connections[0].peer.role == Role.GATEWAY
    for number in range(500):
        assert client.send({"number": number, "text": "ü" * 200})
        assert theirs.connections[0].send({"answer": number})
    until(lambda: len(theirs.lines) == 500 and len(mine.lines) == 500)
    assert [line["number"] for line in theirs.lines] == [line["answer"] for line in mine.lines] == list(range(500))
    agreed = mine.connections[0].negotiated
    assert agreed["version"] == "TLSv1.3" and agreed["cipher"] == "TLS_CHACHA20_POLY1305_SHA256"
    assert agreed["group"] == "X25519MLKEM768"


@pytest.mark.parametrize(
    ("party", "why"),
    [
        (identity(Role.VEHICLE, days=-1), "expired"),
        (identity(Role.STATION, authority=OTHER, trusts=OWN), "unknown ca|authority"),
        (identity(Role.GATEWAY), "certificate|handshake"),
    ],
    ids=["expired", "another authority", "a gateway's"],
)
def test_invalid_certificate_is_refused(gateway: Any, connect: Any, party: Identity, why: str) -> None:
    client, mine = connect(party)
    until(lambda: mine.ends and gateway[1].ends)
    assert not mine.connections and not gateway[1].connections and not client.send({"let": "me in"})


def test_client_without_certificate_is_refused(gateway: Any) -> None:
    import ssl

    open_ = ssl.create_default_context()
    open_.check_hostname, open_.verify_mode = False, ssl.CERT_NONE
    plain = socket.create_connection(("127.0.0.1", gateway[0].port))
    with pytest.raises((ssl.SSLError, OSError)), open_.wrap_socket(plain) as sock:
        sock.send(b'{"let": "me in"}\n')
        while sock.recv(1000):
            pass
        raise OSError("closed")
    until(lambda: gateway[1].ends)
    assert not gateway[1].connections and not gateway[1].lines


def test_client_accepts_only_a_gateway_of_its_authority_and_host(connect: Any) -> None:
    for false in (identity(Role.STATION), identity(Role.VEHICLE), identity(Role.GATEWAY, authority=OTHER)):
        theirs, mine = Side(), Side()
        server = Server(false, "127.0.0.1", 0, **theirs.callbacks)
        client = Client(identity(Role.VEHICLE), "127.0.0.1", server.port, **mine.callbacks)
        until(partial(len, mine.ends))
        client.close()
        server.close()
        assert not mine.connections and not theirs.connections
    client, mine = connect(identity(Role.VEHICLE), "127.0.0.2")  # reaches the gateway, but isn't in its certificate
    until(lambda: mine.ends)
    assert not mine.connections


def test_tls_1_2_uses_the_first_cipher_of_the_list() -> None:
    server = tls.context(identity(Role.GATEWAY), datagrams=False)
    server.set_max_proto_version(SSL.TLS1_2_VERSION)
    ends = [
        Channel(tls.context(identity(Role.VEHICLE), datagrams=False), client=True, accepts=lambda peer: True),
        Channel(server, client=False, accepts=lambda peer: True),
    ]
    for _ in range(4):
        for here, there in (ends, ends[::-1]):
            here.established or here.handshake()
            if data := here.take():
                there.put(data)
    assert ends[0].negotiated()["cipher"] == "ECDHE-ECDSA-CHACHA20-POLY1305"
    assert ends[0].negotiated()["version"] == "TLSv1.2"


@pytest.mark.parametrize("sent", [b"hello\n", b"[1]\n", b'{"a": NaN}\n', b"[" * 5000 + b"\n", b"x" * 70000])
def test_malformed_lines_end_the_connection(gateway: Any, sent: bytes) -> None:
    channel = Channel(tls.context(identity(Role.VEHICLE), datagrams=False), client=True, accepts=lambda peer: True)
    with socket.create_connection(("127.0.0.1", gateway[0].port)) as sock:
        channel.handshake()
        while not channel.established:
            sock.sendall(channel.take())
            channel.put(sock.recv(2**16))
            channel.handshake()
        channel.write(sent)
        sock.sendall(channel.take())
        until(lambda: gateway[1].ends)
    assert gateway[1].ends[0].startswith("received a line") and not gateway[1].lines


def test_only_a_slow_reader_is_disconnected(gateway: Any, connect: Any, request: pytest.FixtureRequest) -> None:
    gate, (server, theirs) = threading.Event(), gateway

    def busy(*arguments: Any) -> None:
        gate.wait()

    slow = Client(identity(Role.STATION), "127.0.0.1", server.port, **(Side().callbacks | {"received": busy}))
    request.addfinalizer(slow.close)
    request.addfinalizer(gate.set)
    until(lambda: theirs.connections)
    _, mine = connect(identity(Role.VEHICLE))
    until(lambda: len(theirs.connections) == 2)
    first = theirs.connections[0]
    while first.send({"text": "x" * 50_000}):
        pass
    assert theirs.connections[1].send({"still": "here"})
    until(lambda: mine.lines)
    until(lambda: theirs.ends)
    assert "too slowly" in theirs.ends[0]


def test_client_reconnects_after_a_restart_of_the_gateway(gateway: Any, connect: Any) -> None:
    server, _ = gateway
    client, mine = connect(identity(Role.VEHICLE))
    until(lambda: client.connected)
    server.close()
    until(lambda: mine.ends)
    assert not client.connected and not client.send({})
    again = Side()
    second = Server(identity(Role.GATEWAY), "127.0.0.1", server.port, **again.callbacks)
    mine.advance(client, json_stream.RECONNECT_DELAYS_S[1])
    until(lambda: again.connections and client.send({"back": 1}))
    until(lambda: again.lines)
    second.close()


def test_silent_connections_do_not_block_others_for_long(gateway: Any, connect: Any) -> None:
    server, theirs = gateway
    count = json_stream.HANDSHAKES_MAX
    idle = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(count)]
    until(lambda: len(server._connections) == count)
    client, mine = connect(identity(Role.VEHICLE))
    until(lambda: mine.ends)
    assert not client.connected
    theirs.advance(server, json_stream.HANDSHAKE_TIMEOUT_S + 0.1)
    until(lambda: len(theirs.ends) == count)
    assert set(theirs.ends) == {"timed out"}
    mine.advance(client, json_stream.RECONNECT_DELAYS_S[1])
    until(lambda: client.connected)
    for sock in idle:
        sock.close()
    assert len(theirs.connections) == 1


def test_lost_peer_is_detected(gateway: Any, connect: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    server, theirs = gateway
    client, mine = connect(identity(Role.VEHICLE), clock=theirs.clock)
    until(lambda: client.connected and theirs.connections)
    ends = theirs.connections[0], mine.connections[0]
    for _ in range(10):  # kept open by heartbeats alone
        theirs.advance(server, json_stream.HEARTBEAT_S + 0.01)
        client.wake()
        until(lambda: ends[0].last_received == ends[1].last_received == theirs.clock.now)
    assert client.connected and not mine.ends and not theirs.ends
    monkeypatch.setattr(Connection, "_send", lambda self, line: True)
    theirs.advance(server, json_stream.IDLE_TIMEOUT_S + 0.01)
    until(lambda: theirs.ends and mine.ends)
    assert "timed out" in {theirs.ends[0], mine.ends[0]}  # the first to notice closes the connection


def test_invalid_input_raises_tls_error() -> None:
    channel = Channel(tls.context(identity(Role.STATION), datagrams=False), client=False, accepts=lambda peer: True)
    channel.put(b"GET / HTTP/1.1\r\n\r\n")
    with pytest.raises(TlsError):
        channel.handshake()
