"""UDP sockets in non-blocking mode, and a reactor thread that reads them and calls a timer; used by both sides.

Both sides depend on the protocols `Reactor` and `UdpSocket` alone; `UdpReactor` implements them with real sockets.
"""

from __future__ import annotations

import ipaddress
import logging
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from scan2sim.services.teleoperation.transport.tls import DATAGRAM_MAX_BYTES

log = logging.getLogger(__name__)

SOCKET_BUFFER_BYTES = 4 * 2**20
"""Requested size of the kernel's send and receive buffers of a socket."""
DATAGRAMS_PER_READ_MAX = 64
"""Maximum number of datagrams read from a socket before others get a turn."""
TICK_S = 0.025
"""Interval of the timer."""


Address = tuple[object, ...]


class UdpSocket(Protocol):
    """What both sides use of a UDP socket."""

    def fileno(self) -> int:
        """Number of the socket; no other open socket has the same."""

    def getsockname(self) -> Address:
        """Local address."""

    def send(self, data: bytes, /) -> int:
        """Send a datagram to the address that the socket is connected to; raises OSError."""

    def sendto(self, data: bytes, address: Any, /) -> int:
        """Send a datagram; raises OSError."""


class Reactor(Protocol):
    """Opens sockets, reads them and calls a timer."""

    def bind(self, host: str, port: int) -> UdpSocket:
        """Open a socket that receives at an address, and read it; raises OSError."""

    def connect(self, local: str, remote: tuple[str, int]) -> UdpSocket:
        """Open a socket to a remote address from a local IP address, interface or, if empty, the default route.

        It is read from now on. Call it in the reactor's thread. Raises OSError if there is no such route now.
        """

    def remove(self, sock: UdpSocket) -> None:
        """Stop reading a socket, and close it; in the reactor's thread."""

    def call_soon(self, callback: Callable[[], None]) -> None:
        """Call a function in the reactor's thread."""

    def start(self) -> None:
        """Start reading and calling the timer."""

    def end(self) -> None:
        """Call what is left of `call_soon`, close all sockets, and wait for the end."""


OpenReactor = Callable[[Callable[[Any, bytes, Address], None], Callable[[float], None], Callable[[], float]], Reactor]
"""Creates a reactor from the arguments of `UdpReactor`."""


def is_address(text: str) -> bool:
    """Whether a text is an IP address."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def _udp_socket(host: str) -> socket.socket:
    sock = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        sock.setsockopt(socket.SOL_SOCKET, option, SOCKET_BUFFER_BYTES)
    return sock


def format_address(address: Address) -> str:
    """Format an address as HOST:PORT."""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"


class UdpReactor(threading.Thread):
    """Reads sockets and calls a timer, in one thread; one reactor per side.

    Args:
        received: called for each datagram with socket, bytes and source address.
        tick: called every `TICK_S` seconds with the time.
        clock: current time, seconds.
    """

    def __init__(
        self,
        received: Callable[[socket.socket, bytes, Address], None],
        tick: Callable[[float], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(name="teleop-links", daemon=True)
        self._received, self._tick, self._clock = received, tick, clock
        self._selector = selectors.DefaultSelector()
        self._callbacks: deque[Callable[[], None]] = deque()
        self._stopping = threading.Event()
        self._wake_receiver, self._wake_sender = socket.socketpair()
        self._wake_receiver.setblocking(False)
        self._wake_sender.setblocking(False)
        self._selector.register(self._wake_receiver, selectors.EVENT_READ)

    def bind(self, host: str, port: int) -> socket.socket:
        """Open a socket that receives at an address, and read it; in the reactor's thread, or before it starts.

        Raises:
            OSError: the address isn't of this machine, or its port is in use.
        """
        return self._open(host, lambda sock: sock.bind((host, port)))

    def connect(self, local: str, remote: tuple[str, int]) -> socket.socket:
        """Open a socket to a remote address, and read it; in the reactor's thread, or before it starts.

        Args:
            local: IP address, or interface name; empty: the system's default route.

        Raises:
            OSError: there is no such route now.
        """

        def prepare(sock: socket.socket) -> None:
            if local and is_address(local):
                sock.bind((local, 0))
            elif local:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, local.encode())
            sock.connect(remote)

        return self._open(remote[0], prepare)

    def remove(self, sock: UdpSocket) -> None:
        """Stop reading a socket, and close it; in the reactor's thread."""
        assert isinstance(sock, socket.socket)
        self._selector.unregister(sock)
        sock.close()

    def call_soon(self, callback: Callable[[], None]) -> None:
        """Call a function in the reactor's thread."""
        self._callbacks.append(callback)
        self._wake()

    def end(self) -> None:
        """Stop the reactor, and wait for its end."""
        self._stopping.set()
        self._wake()
        if threading.current_thread() is not self:
            self.join(5)

    def run(self) -> None:
        """Read until `end`."""
        due = 0.0
        try:
            while not self._stopping.is_set():
                for key, _ in self._selector.select(max(0.0, due - self._clock())):
                    sock = key.fileobj
                    assert isinstance(sock, socket.socket)
                    self._wake_receiver.recv(4096) if sock is self._wake_receiver else self._read(sock)
                while self._callbacks:
                    self._callbacks.popleft()()
                if (now := self._clock()) >= due:
                    due = now + TICK_S
                    self._tick(now)
            while self._callbacks:
                self._callbacks.popleft()()
        except Exception:
            log.exception("the links have ended after an error")
            raise
        finally:
            for key in list(self._selector.get_map().values()):
                assert isinstance(key.fileobj, socket.socket)
                key.fileobj.close()
            self._selector.close()
            self._wake_sender.close()

    def _open(self, host: str, prepare: Callable[[socket.socket], None]) -> socket.socket:
        sock = _udp_socket(host)
        try:
            prepare(sock)
        except OSError:
            sock.close()
            raise
        self._selector.register(sock, selectors.EVENT_READ)
        return sock

    def _read(self, sock: socket.socket) -> None:
        for _ in range(DATAGRAMS_PER_READ_MAX):
            try:
                data, address = sock.recvfrom(DATAGRAM_MAX_BYTES + 1)
            except BlockingIOError:
                return
            except OSError:  # ICMP error: nobody listens there
                continue
            self._received(sock, data, address)
            if sock.fileno() < 0:  # the callback has closed it
                return

    def _wake(self) -> None:
        try:
            self._wake_sender.send(b"\0")
        except OSError:  # it is awake already, or has ended
            pass
