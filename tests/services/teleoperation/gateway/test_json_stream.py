"""The gateway's connections: who gets in, and what comes of bad lines, slow readers and restarts."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
from OpenSSL import SSL

from scan2sim.services.teleoperation.gateway import json_stream as stream
from scan2sim.services.teleoperation.gateway.identity import Identity, Role
from scan2sim.services.teleoperation.gateway.json_stream import Client, Server, Stream
from scan2sim.services.teleoperation.transport import tls
from scan2sim.services.teleoperation.transport.tls import Channel, Refused
from tests.services.teleoperation.certificates import OTHER, OWN, identity


def until(said: Callable[[], Any], seconds: float = 60) -> None:
    """Wait for it."""
    end = time.monotonic() + seconds
    while not said():
        assert time.monotonic() < end, "it didn't come"
        time.sleep(0.005)


class Side:
    """What one side was told."""

    def __init__(self) -> None:
        self.streams: list[Stream] = []
        self.lines: list[Any] = []
        self.ends: list[str] = []

    def opened(self, stream: Stream) -> None:
        self.streams.append(stream)

    def received(self, stream: Stream, told: Any) -> None:
        self.lines.append(told)

    def closed(self, *why: Any) -> None:
        self.ends.append(str(why[-1]))

    @property
    def told(self) -> dict[str, Any]:
        return {"opened": self.opened, "received": self.received, "closed": self.closed}


@pytest.fixture
def gateway() -> Iterator[tuple[Server, Side]]:
    side = Side()
    server = Server(identity(Role.GATEWAY), "127.0.0.1", 0, **side.told)
    yield server, side
    server.close()


@pytest.fixture
def connect(gateway: tuple[Server, Side]) -> Iterator[Callable[..., tuple[Client, Side]]]:
    made: list[Client] = []

    def client(who: Identity, host: str = "127.0.0.1") -> tuple[Client, Side]:
        side = Side()
        made.append(Client(who, host, gateway[0].port, **side.told))
        return made[-1], side

    yield client
    for one in made:
        one.close()


def test_lines_go_both_ways_and_the_gateway_knows_who_sent_them(gateway: Any, connect: Any) -> None:
    car = identity(Role.VEHICLE, "car")
    client, mine = connect(car)
    until(lambda: client.connected)
    theirs = gateway[1]
    until(lambda: theirs.streams)
    assert theirs.streams[0].peer == car.me and mine.streams[0].peer.role == Role.GATEWAY
    for number in range(500):
        assert client.send({"number": number, "text": "ü" * 200})
        assert theirs.streams[0].send({"answer": number})
    until(lambda: len(theirs.lines) == 500 and len(mine.lines) == 500)
    assert [line["number"] for line in theirs.lines] == [line["answer"] for line in mine.lines] == list(range(500))
    agreed = mine.streams[0].agreed
    assert agreed["version"] == "TLSv1.3" and agreed["cipher"] == "TLS_CHACHA20_POLY1305_SHA256"
    assert agreed["group"] == "X25519MLKEM768"


@pytest.mark.parametrize(
    ("who", "why"),
    [
        (identity(Role.VEHICLE, days=-1), "expired"),
        (identity(Role.STATION, authority=OTHER, believes=OWN), "unknown ca|authority"),
        (identity(Role.GATEWAY), "certificate|handshake"),
    ],
    ids=["expired", "another authority", "a gateway's"],
)
def test_who_is_no_party_gets_in_nowhere(gateway: Any, connect: Any, who: Identity, why: str) -> None:
    client, mine = connect(who)
    until(lambda: mine.ends and gateway[1].ends)
    assert not mine.streams and not gateway[1].streams and not client.send({"let": "me in"})


def test_nobody_gets_in_without_a_certificate(gateway: Any) -> None:
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
    assert not gateway[1].streams and not gateway[1].lines


def test_a_client_talks_to_a_gateway_of_its_authority_and_host_alone(connect: Any) -> None:
    for false in (identity(Role.STATION), identity(Role.VEHICLE), identity(Role.GATEWAY, authority=OTHER)):
        theirs, mine = Side(), Side()
        server = Server(false, "127.0.0.1", 0, **theirs.told)
        client = Client(identity(Role.VEHICLE), "127.0.0.1", server.port, **mine.told)
        until(partial(len, mine.ends))
        client.close()
        server.close()
        assert not mine.streams and not theirs.streams
    client, mine = connect(identity(Role.VEHICLE), "127.0.0.2")  # leads there, but isn't in its certificate
    until(lambda: mine.ends)
    assert not mine.streams


def test_tls_1_2_takes_the_missions_first_cipher() -> None:
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
    assert ends[0].agreed()["cipher"] == "ECDHE-ECDSA-CHACHA20-POLY1305"
    assert ends[0].agreed()["version"] == "TLSv1.2"


@pytest.mark.parametrize("sent", [b"hello\n", b"[1]\n", b'{"a": NaN}\n', b"[" * 5000 + b"\n", b"x" * 70000])
def test_lines_that_are_none_end_the_connection(gateway: Any, sent: bytes) -> None:
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
    assert gateway[1].ends[0].startswith("it sent a line") and not gateway[1].lines


def test_a_reader_that_is_too_slow_is_cut_off_and_nobody_else(gateway: Any, connect: Any) -> None:
    gate, (server, theirs) = threading.Event(), gateway

    def busy(*told: Any) -> None:
        gate.wait(20)

    slow = Side()
    client = Client(
        identity(Role.STATION), "127.0.0.1", server.port,
        opened=slow.opened, received=busy, closed=slow.closed,
    )  # fmt: skip
    until(lambda: theirs.streams)
    _, mine = connect(identity(Role.VEHICLE))
    until(lambda: len(theirs.streams) == 2)
    first = theirs.streams[0]
    while first.send({"text": "x" * 50_000}):
        pass
    assert theirs.streams[1].send({"still": "here"})
    until(lambda: mine.lines)
    until(lambda: theirs.ends)
    assert "too slowly" in theirs.ends[0]
    gate.set()
    client.close()


def test_a_client_is_back_after_a_restart_of_the_gateway(gateway: Any, connect: Any) -> None:
    server, _ = gateway
    client, mine = connect(identity(Role.VEHICLE))
    until(lambda: client.connected)
    server.close()
    until(lambda: mine.ends)
    assert not client.connected and not client.send({})
    again = Side()
    second = Server(identity(Role.GATEWAY), "127.0.0.1", server.port, **again.told)
    until(lambda: again.streams and client.send({"back": 1}))
    until(lambda: again.lines)
    second.close()


def test_many_who_say_nothing_keep_nobody_out_for_long(
    gateway: Any, connect: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "GREETED", 0.5)
    idle = [socket.create_connection(("127.0.0.1", gateway[0].port)) for _ in range(stream.STRANGERS + 20)]
    client, _ = connect(identity(Role.VEHICLE))
    until(lambda: client.connected)
    for sock in idle:
        sock.close()
    assert len(gateway[1].streams) == 1


def test_a_peer_that_vanishes_is_noticed(gateway: Any, connect: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "BEAT", 0.1)
    monkeypatch.setattr(stream, "SILENT", 0.6)
    client, mine = connect(identity(Role.VEHICLE))
    until(lambda: client.connected)
    time.sleep(1)
    assert client.connected and not mine.ends  # signs of life alone keep it
    monkeypatch.setattr(Stream, "_send", lambda self, line: True)
    until(lambda: "nothing more came" in gateway[1].ends)


def test_what_is_put_in_wrongly_is_refused_not_raised_otherwise() -> None:
    channel = Channel(tls.context(identity(Role.STATION), datagrams=False), client=False, accepts=lambda peer: True)
    channel.put(b"GET / HTTP/1.1\r\n\r\n")
    with pytest.raises(Refused):
        channel.handshake()
