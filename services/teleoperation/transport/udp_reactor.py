"""UDP as both ends use it: sockets that never block, and the thread that reads them all."""

from __future__ import annotations

import logging
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable

from scan2sim.services.teleoperation.transport.tls import DATAGRAM

log = logging.getLogger(__name__)

BUFFER = 4 * 2**20
"""Bytes that the kernel may hold for a socket, where it lets us."""
BATCH = 64
"""Datagrams read of a socket before it is another's turn."""
TICK = 0.025
"""Seconds between looks at timers."""


def udp(family: int) -> socket.socket:
    """A socket that never blocks."""
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.setblocking(False)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        sock.setsockopt(socket.SOL_SOCKET, option, BUFFER)
    return sock


def shown(address: tuple[object, ...]) -> str:
    """HOST:PORT."""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"


class Reader(threading.Thread):
    """Reads sockets, and looks at timers between; one a side.

    Args:
        came: is given each datagram: its socket, its bytes, where it came from.
        tick: is called every `TICK` seconds, with the monotonic clock's.
    """

    def __init__(
        self, came: Callable[[socket.socket, bytes, tuple[object, ...]], None], tick: Callable[[float], None]
    ) -> None:
        super().__init__(name="teleop-links", daemon=True)
        self._came, self._tick = came, tick
        self._selector = selectors.DefaultSelector()
        self._todo: deque[Callable[[], None]] = deque()
        self._ends = threading.Event()
        self._inner, self._outer = socket.socketpair()
        self._inner.setblocking(False)
        self._outer.setblocking(False)
        self._selector.register(self._inner, selectors.EVENT_READ)

    def add(self, sock: socket.socket) -> None:
        """Read it, too; its own thread's, or before it starts."""
        self._selector.register(sock, selectors.EVENT_READ)

    def remove(self, sock: socket.socket) -> None:
        """Read it no more, and close it; its own thread's."""
        self._selector.unregister(sock)
        sock.close()

    def soon(self, do: Callable[[], None]) -> None:
        """Have something done in its thread."""
        self._todo.append(do)
        self._wake()

    def end(self) -> None:
        """Have it end, and wait for that."""
        self._ends.set()
        self._wake()
        if threading.current_thread() is not self:
            self.join(5)

    def run(self) -> None:
        """Read until the end."""
        due = 0.0
        try:
            while not self._ends.is_set():
                for key, _ in self._selector.select(max(0.0, due - time.monotonic())):
                    sock = key.fileobj
                    assert isinstance(sock, socket.socket)
                    self._inner.recv(4096) if sock is self._inner else self._read(sock)
                while self._todo:
                    self._todo.popleft()()
                if (now := time.monotonic()) >= due:
                    due = now + TICK
                    self._tick(now)
            while self._todo:
                self._todo.popleft()()
        except Exception:
            log.exception("links have ended by a fault")
            raise
        finally:
            for key in list(self._selector.get_map().values()):
                assert isinstance(key.fileobj, socket.socket)
                key.fileobj.close()
            self._selector.close()
            self._outer.close()

    def _read(self, sock: socket.socket) -> None:
        for _ in range(BATCH):
            try:
                data, address = sock.recvfrom(DATAGRAM + 1)
            except BlockingIOError:
                return
            except OSError:  # nobody listens there (any more), as the network tells
                continue
            self._came(sock, data, address)
            if sock.fileno() < 0:  # what came has closed it
                return

    def _wake(self) -> None:
        try:
            self._outer.send(b"\0")
        except OSError:  # it is awake, or has ended
            pass
