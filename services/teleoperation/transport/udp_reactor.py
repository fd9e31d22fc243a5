"""UDP sockets in non-blocking mode, and a reactor thread that reads them and calls a timer; used by both sides."""

from __future__ import annotations

import logging
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable

from scan2sim.services.teleoperation.transport.tls import DATAGRAM_MAX_BYTES

log = logging.getLogger(__name__)

SOCKET_BUFFER_BYTES = 4 * 2**20
"""Requested size of the kernel's send and receive buffers of a socket."""
DATAGRAMS_PER_READ_MAX = 64
"""Maximum number of datagrams read from a socket before others get a turn."""
TICK_S = 0.025
"""Interval of the timer."""


def udp_socket(family: int) -> socket.socket:
    """Create a non-blocking UDP socket."""
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.setblocking(False)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        sock.setsockopt(socket.SOL_SOCKET, option, SOCKET_BUFFER_BYTES)
    return sock


def format_address(address: tuple[object, ...]) -> str:
    """Format an address as HOST:PORT."""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"


class UdpReactor(threading.Thread):
    """Reads sockets and calls a timer, in one thread; one reactor per side.

    Args:
        received: called for each datagram with socket, bytes and source address.
        tick: called every `TICK_S` seconds with the time of the monotonic clock.
    """

    def __init__(
        self, received: Callable[[socket.socket, bytes, tuple[object, ...]], None], tick: Callable[[float], None]
    ) -> None:
        super().__init__(name="teleop-links", daemon=True)
        self._received, self._tick = received, tick
        self._selector = selectors.DefaultSelector()
        self._callbacks: deque[Callable[[], None]] = deque()
        self._stopping = threading.Event()
        self._wake_receiver, self._wake_sender = socket.socketpair()
        self._wake_receiver.setblocking(False)
        self._wake_sender.setblocking(False)
        self._selector.register(self._wake_receiver, selectors.EVENT_READ)

    def add(self, sock: socket.socket) -> None:
        """Start reading a socket; in the reactor's thread, or before it starts."""
        self._selector.register(sock, selectors.EVENT_READ)

    def remove(self, sock: socket.socket) -> None:
        """Stop reading a socket, and close it; in the reactor's thread."""
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
                for key, _ in self._selector.select(max(0.0, due - time.monotonic())):
                    sock = key.fileobj
                    assert isinstance(sock, socket.socket)
                    self._wake_receiver.recv(4096) if sock is self._wake_receiver else self._read(sock)
                while self._callbacks:
                    self._callbacks.popleft()()
                if (now := time.monotonic()) >= due:
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
