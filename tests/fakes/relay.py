"""A network for tests: relays UDP between two ends with delay, loss or cuts, by the sending host of the near end."""

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
    """Properties of a link."""

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    cut: bool = False
    duplication: float = 0.0


class Relay(threading.Thread):
    """Represents the far end, at `address`."""

    def __init__(self, far: tuple[str, int], seed: int = 1) -> None:
        super().__init__(daemon=True)
        self.shapes: dict[str, Shape] = defaultdict(Shape)
        self.recorded: list[tuple[str, bytes]] = []
        self.recording = False
        self._far, self._random = far, random.Random(seed)
        self._near = self._socket(("127.0.0.1", 0))
        self.address: tuple[str, int] = self._near.getsockname()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._near, selectors.EVENT_READ)
        self._out: dict[tuple[str, int], socket.socket] = {}
        self._source_of: dict[socket.socket, tuple[str, int]] = {}
        self._queue: list[tuple[float, int, socket.socket, bytes, tuple[str, int]]] = []
        self._order = itertools.count()
        self._stopping = threading.Event()
        self.start()

    def rebind(self) -> None:
        """Use other source ports from now on, like a NAT that lost its mappings."""
        self._out = {}

    def close(self) -> None:
        self._stopping.set()
        self.join()
        for sock in (self._near, *self._source_of):
            sock.close()

    def run(self) -> None:
        while not self._stopping.is_set():
            pause = max(0.0, min(0.05, self._queue[0][0] - time.monotonic())) if self._queue else 0.05
            for key, _ in self._selector.select(pause):
                assert isinstance(key.fileobj, socket.socket)
                self._receive(key.fileobj)
            while self._queue and self._queue[0][0] <= time.monotonic():
                _, _, sock, data, to = heapq.heappop(self._queue)
                sock.sendto(data, to)

    def _receive(self, sock: socket.socket) -> None:
        for _ in range(100):
            try:
                data, source = sock.recvfrom(4096)
            except BlockingIOError:
                return
            except OSError:
                continue
            if sock is self._near:
                self._forward(self._upstream(source), data, self._far, self.shapes[source[0]])
                if self.recording:
                    self.recorded.append((source[0], data))
            else:
                near = self._source_of[sock]
                self._forward(self._near, data, near, self.shapes[near[0]])

    def _upstream(self, source: tuple[str, int]) -> socket.socket:
        if source not in self._out:
            sock = self._out[source] = self._socket((source[0], 0))
            self._source_of[sock] = source
            self._selector.register(sock, selectors.EVENT_READ)
        return self._out[source]

    def _forward(self, sock: socket.socket, data: bytes, to: tuple[str, int], shape: Shape) -> None:
        if shape.cut or self._random.random() < shape.loss:
            return
        for _ in range(1 + (self._random.random() < shape.duplication)):
            at = time.monotonic() + shape.delay + shape.jitter * self._random.random()
            heapq.heappush(self._queue, (at, next(self._order), sock, data, to))

    @staticmethod
    def _socket(address: tuple[str, int]) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**21)
        sock.setblocking(False)
        sock.bind(address)
        return sock
