"""A network for tests: UDP between two ends, delayed, lost or cut, by the host that the near end sends from."""

from __future__ import annotations

import heapq
import itertools
import random
import selectors
import socket
import threading
import time
from collections import defaultdict
from dataclasses import dataclass


@dataclass
class Shape:
    """How a link is."""

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    cut: bool = False
    twice: float = 0.0


class Relay(threading.Thread):
    """Stands for the far end, at `address`."""

    def __init__(self, far: tuple[str, int], seed: int = 1) -> None:
        super().__init__(daemon=True)
        self.shapes: dict[str, Shape] = defaultdict(Shape)
        self.passed: list[tuple[str, bytes]] = []
        self.recording = False
        self._far, self._random = far, random.Random(seed)
        self._near = self._socket(("127.0.0.1", 0))
        self.address: tuple[str, int] = self._near.getsockname()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._near, selectors.EVENT_READ)
        self._out: dict[tuple[str, int], socket.socket] = {}
        self._of: dict[socket.socket, tuple[str, int]] = {}
        self._wait: list[tuple[float, int, socket.socket, bytes, tuple[str, int]]] = []
        self._order = itertools.count()
        self._ends = threading.Event()
        self.start()

    def rebind(self) -> None:
        """The near ends come from other ports from now on, as behind a NAT that forgot them."""
        self._out = {}

    def close(self) -> None:
        self._ends.set()
        self.join()
        for sock in (self._near, *self._of):
            sock.close()

    def run(self) -> None:
        while not self._ends.is_set():
            pause = max(0.0, min(0.05, self._wait[0][0] - time.monotonic())) if self._wait else 0.05
            for key, _ in self._selector.select(pause):
                assert isinstance(key.fileobj, socket.socket)
                self._take(key.fileobj)
            while self._wait and self._wait[0][0] <= time.monotonic():
                _, _, sock, data, to = heapq.heappop(self._wait)
                sock.sendto(data, to)

    def _take(self, sock: socket.socket) -> None:
        for _ in range(100):
            try:
                data, source = sock.recvfrom(4096)
            except BlockingIOError:
                return
            except OSError:
                continue
            if sock is self._near:
                self._pass(self._upstream(source), data, self._far, self.shapes[source[0]])
                if self.recording:
                    self.passed.append((source[0], data))
            else:
                near = self._of[sock]
                self._pass(self._near, data, near, self.shapes[near[0]])

    def _upstream(self, source: tuple[str, int]) -> socket.socket:
        if source not in self._out:
            sock = self._out[source] = self._socket((source[0], 0))
            self._of[sock] = source
            self._selector.register(sock, selectors.EVENT_READ)
        return self._out[source]

    def _pass(self, sock: socket.socket, data: bytes, to: tuple[str, int], shape: Shape) -> None:
        if shape.cut or self._random.random() < shape.loss:
            return
        for _ in range(1 + (self._random.random() < shape.twice)):
            at = time.monotonic() + shape.delay + shape.jitter * self._random.random()
            heapq.heappush(self._wait, (at, next(self._order), sock, data, to))

    @staticmethod
    def _socket(address: tuple[str, int]) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**21)
        sock.setblocking(False)
        sock.bind(address)
        return sock
