"""JSON lines over TLS between the gateway and those who connect to it: everything but driving.

One thread serves all connections of a `Server`, and one a `Client`, which connects again whenever its own breaks.
Callbacks run in that thread, one at a time, and must not block. A blank line is a sign of life.
"""

from __future__ import annotations

import json
import logging
import selectors
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from scan2sim.pipeline.core.errors import BusyError, SettingError
from scan2sim.services.teleoperation.gateway.identity import Identity, Peer, Role
from scan2sim.services.teleoperation.transport import tls
from scan2sim.services.teleoperation.transport.tls import Channel, Ended, Refused

log = logging.getLogger(__name__)

LONGEST = 2**16
"""Bytes of a line."""
WAITING = 2**20
"""Bytes that may wait for a slow reader; then it is cut off."""
CONNECTIONS, STRANGERS = 256, 64
"""At once; of these, such whose handshake isn't done."""
BEAT, SILENT, GREETED = 2.0, 8.0, 5.0
"""Seconds: between signs of life, without any until the connection is given up, for its handshake."""
AGAIN = (0.25, 5.0)
"""Seconds until a client connects again: at first, and at most (it doubles)."""

Told = dict[str, Any]


class Stream:
    """A connection.

    Attributes:
        peer: who is at the other end (once it is opened).
        address: where that is, HOST:PORT.
    """

    def __init__(self, sock: socket.socket, channel: Channel, wake: Callable[[], None]) -> None:
        self.address = channel.address
        self.since = self.heard = self.told = time.monotonic()
        self.opened = False
        self._sock, self._channel, self._wake = sock, channel, wake
        self._lock = threading.Lock()
        self._in, self._out = bytearray(), bytearray()
        self._closing = ""

    @property
    def peer(self) -> Peer:
        """Who is at the other end."""
        assert self._channel.peer is not None
        return self._channel.peer

    @property
    def agreed(self) -> dict[str, str]:
        """Version, cipher and group of the encryption."""
        with self._lock:
            return self._channel.agreed()

    def send(self, told: Mapping[str, Any]) -> bool:
        """Queue a line, from any thread; False: the connection is over, or its reader too slow and now cut off."""
        return self._send(json.dumps(told, separators=(",", ":"), allow_nan=False).encode() + b"\n")

    def close(self, why: str = "closed here") -> None:
        """End it, once what waits is sent."""
        self._closing = self._closing or why
        self._wake()

    def _send(self, line: bytes) -> bool:
        with self._lock:
            if self._closing:
                return False
            try:
                self._channel.write(line)
            except Refused as error:
                self._closing = str(error)
            else:
                self._out += self._channel.take()
                self.told = time.monotonic()
                if len(self._out) > WAITING:
                    self._out.clear()
                    self._closing = "it reads too slowly"
        self._wake()
        return not self._closing

    def _receive(self) -> list[bytes]:
        """Lines of what has come."""
        data = self._sock.recv(2**16)
        if not data:
            raise Ended
        with self._lock:
            self._channel.put(data)
            try:
                if self._channel.established or self._channel.handshake():
                    while (part := self._channel.read()) is not None:
                        self._in += part
            finally:
                self._out += self._channel.take()
        *lines, rest = self._in.split(b"\n")
        if len(rest) > LONGEST or any(len(line) > LONGEST for line in lines):
            raise Refused("it sent a line that is too long")
        self._in = rest
        if lines:
            self.heard = time.monotonic()
        return [bytes(line) for line in lines]

    def _begin(self) -> None:
        with self._lock:
            self._channel.handshake()
            self._out += self._channel.take()

    def _flush(self) -> None:
        with self._lock:
            while self._out and (sent := self._sock.send(self._out)):
                del self._out[:sent]

    def _end(self) -> None:
        with self._lock:
            self._closing = self._closing or "closed"
            self._channel.close()
            try:
                self._sock.send(self._out + self._channel.take())
            except OSError:
                pass
        self._sock.close()


class _Connections(threading.Thread):
    """All connections of a side, in one thread."""

    def __init__(
        self,
        name: str,
        opened: Callable[[Stream], None],
        received: Callable[[Stream, Told], None],
        closed: Callable[[Stream, str], None],
    ) -> None:
        super().__init__(name=name, daemon=True)
        self._tell = (opened, received, closed)
        self._selector = selectors.DefaultSelector()
        self._streams: dict[socket.socket, Stream] = {}
        self._ends = threading.Event()
        self._inner, self._outer = socket.socketpair()
        self._inner.setblocking(False)
        self._outer.setblocking(False)
        self._selector.register(self._inner, selectors.EVENT_READ)

    def wake(self) -> None:
        """Look at once whether there is something to do."""
        try:
            self._outer.send(b"\0")
        except OSError:  # it is awake, or has ended
            pass

    def close(self) -> None:
        """End all connections, and the thread."""
        self._ends.set()
        self.wake()
        if threading.current_thread() is not self:
            self.join(GREETED)

    def run(self) -> None:
        """Serve until closed."""
        try:
            while not self._ends.is_set():
                for key, events in self._selector.select(self._pause()):
                    sock = key.fileobj
                    assert isinstance(sock, socket.socket)
                    if sock is self._inner:
                        self._inner.recv(4096)
                    elif (stream := self._streams.get(sock)) is None:
                        self._accept()
                    elif events & selectors.EVENT_READ:
                        self._read(stream)
                self._look(time.monotonic())
        finally:
            for stream in list(self._streams.values()):
                self._drop(stream, "closed here")
            self._selector.close()
            self._inner.close()
            self._outer.close()

    def _pause(self) -> float:
        return 0.5

    def _accept(self) -> None:
        """Someone connects."""

    def _add(self, sock: socket.socket, channel: Channel) -> Stream:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        stream = self._streams[sock] = Stream(sock, channel, self.wake)
        self._selector.register(sock, selectors.EVENT_READ)
        return stream

    def _look(self, now: float) -> None:
        """Send what waits, end what is over."""
        for stream in list(self._streams.values()):
            if stream.opened and now - stream.told > BEAT:
                stream._send(b"\n")
            if stream._closing:
                self._drop(stream, stream._closing)
            elif now - stream.heard > (SILENT if stream.opened else GREETED):
                self._drop(stream, "nothing more came")
            else:
                self._write(stream)

    def _write(self, stream: Stream) -> None:
        try:
            stream._flush()
        except BlockingIOError:
            pass
        except OSError as error:
            return self._drop(stream, str(error.strerror))
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if stream._out else 0)
        if self._selector.get_key(stream._sock).events != wanted:
            self._selector.modify(stream._sock, wanted)

    def _read(self, stream: Stream) -> None:
        try:
            lines = stream._receive()
            if not stream.opened and self._ready(stream, lines):
                stream.opened = True
                self._tell[0](stream)
            for line in filter(None, lines):
                self._tell[1](stream, _parsed(line))
        except BlockingIOError:
            pass
        except Ended:
            self._drop(stream, "the other end closed it")
        except Refused as error:
            self._drop(stream, str(error))
        except OSError as error:
            self._drop(stream, str(error.strerror))

    def _ready(self, stream: Stream, lines: list[bytes]) -> bool:
        """Whether it is open now."""
        return stream._channel.established

    def _drop(self, stream: Stream, why: str) -> None:
        if self._streams.pop(stream._sock, None) is not None:
            self._selector.unregister(stream._sock)
            stream._end()
            self._tell[2](stream, why)


class Server(_Connections):
    """The gateway's side.

    Args:
        port: 0: any.
        accepts: whether a party is let in, whose certificate holds; the gateway's own role never is.
        opened, received, closed: told of each connection; `closed` of such, too, that weren't `opened`.

    Raises:
        SettingError: it can't listen there.
        BusyError: something else does.
    """

    def __init__(
        self,
        identity: Identity,
        host: str,
        port: int,
        *,
        opened: Callable[[Stream], None],
        received: Callable[[Stream, Told], None],
        closed: Callable[[Stream, str], None],
        accepts: Callable[[Peer], bool] = lambda peer: True,
    ) -> None:
        super().__init__("teleop-server", opened, received, closed)
        self._context = tls.context(identity, datagrams=False)
        self._accepts = accepts
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._listening = socket.create_server((host, port), family=family, backlog=STRANGERS)
        except OSError as error:
            if error.errno == 98:
                raise BusyError(
                    f"{host}:{port}", "another program listens there", "End it, or choose another"
                ) from None
            raise SettingError(f"{host}:{port}", str(error.strerror), "Name an address of this machine") from None
        self._listening.setblocking(False)
        self.port: int = self._listening.getsockname()[1]
        self._selector.register(self._listening, selectors.EVENT_READ)
        self.start()

    def run(self) -> None:
        """Serve until closed."""
        try:
            super().run()
        finally:
            self._listening.close()

    def _accept(self) -> None:
        try:
            sock, (host, port, *_) = self._listening.accept()
        except OSError:
            return
        strangers = Counter(stream.opened for stream in self._streams.values())[False]
        if strangers >= STRANGERS or len(self._streams) >= CONNECTIONS:
            sock.close()
            return
        channel = Channel(self._context, client=False, accepts=self._let_in, address=f"{host}:{port}")
        self._add(sock, channel)

    def _let_in(self, peer: Peer) -> bool:
        return peer.role != Role.GATEWAY and self._accepts(peer)

    def _ready(self, stream: Stream, lines: list[bytes]) -> bool:
        return stream._channel.established and stream._send(b"\n")


class Client(_Connections):
    """A vehicle's or station's side: connects to the gateway, again and again.

    Args:
        closed: told why, also of attempts that failed; the next one follows by itself.
    """

    def __init__(
        self,
        identity: Identity,
        host: str,
        port: int,
        *,
        opened: Callable[[Stream], None],
        received: Callable[[Stream, Told], None],
        closed: Callable[[str], None],
    ) -> None:
        super().__init__("teleop-client", opened, received, lambda stream, why: self._lost(why))
        self._context = tls.context(identity, datagrams=False)
        self._place, self._closed = (host, port), closed
        self._next, self._wait = 0.0, AGAIN[0]
        self.start()

    def send(self, told: Mapping[str, Any]) -> bool:
        """Queue a line; False: it isn't connected."""
        stream = next((one for one in list(self._streams.values()) if one.opened), None)
        return stream is not None and stream.send(told)

    @property
    def connected(self) -> bool:
        """Whether it is."""
        return any(one.opened for one in list(self._streams.values()))

    def _pause(self) -> float:
        return 0.5 if self._streams else max(0.0, min(0.5, self._next - time.monotonic()))

    def _look(self, now: float) -> None:
        super()._look(now)
        if not self._streams and now >= self._next and not self._ends.is_set():
            self._connect()

    def _connect(self) -> None:
        host, port = self._place
        self._next = time.monotonic() + self._wait
        try:
            sock = socket.create_connection((host, port), timeout=GREETED)
        except OSError as error:
            return self._lost(f"{host}:{port}: {error.strerror or error}")
        channel = Channel(self._context, client=True, accepts=self._expected, address=f"{host}:{port}")
        stream = self._add(sock, channel)
        stream._begin()
        self._write(stream)
        return None

    def _expected(self, peer: Peer) -> bool:
        return peer.role == Role.GATEWAY and self._place[0] in peer.hosts

    def _ready(self, stream: Stream, lines: list[bytes]) -> bool:
        if lines:  # in TLS 1.3 the server looks at our certificate after we are done
            self._wait = AGAIN[0]
        return bool(lines)

    def _lost(self, why: str) -> None:
        self._next = time.monotonic() + self._wait
        self._wait = min(2 * self._wait, AGAIN[1])
        self._closed(why)


def _parsed(line: bytes) -> Told:
    try:
        told = json.loads(line, parse_constant=_refuse)
    except (ValueError, RecursionError):
        told = None
    if not isinstance(told, dict):
        raise Refused("it sent a line that is no JSON object")
    return told


def _refuse(constant: str) -> None:
    raise ValueError(constant)
