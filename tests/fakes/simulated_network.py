"""A network in virtual time: machines, the links between them, and their traffic, in one thread without sockets.

Events are handled in the order of their times, and time passes only between them, so a test gives the same result on
any machine. A `Machine` opens reactors for the two sides of a multipath connection, which read simulated sockets; it
can stall, as a process does on a busy or suspended machine: what arrives meanwhile waits in its sockets.

OpenSSL retransmits lost handshake records by the real clock (use `without_retransmission`). So that handshakes succeed
without it, their datagrams are neither lost at random nor reordered; links that are cut lose them like any other.
"""

from __future__ import annotations

import errno
import heapq
import itertools
import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from random import Random
from typing import Any

import pytest

from scan2sim.services.teleoperation.transport.tls import Channel
from scan2sim.services.teleoperation.transport.udp_reactor import TICK_S, Address, UdpSocket

Endpoint = tuple[str, int]
_HANDSHAKE_RECORDS = (20, 22)
SOCKET_QUEUE_MAX = 4096
"""Datagrams that a socket holds while its machine stalls."""


def without_retransmission(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable OpenSSL's retransmission of handshake records, which depends on the real clock."""
    monkeypatch.setattr(Channel, "retransmit_delay", lambda self: None)


@dataclass
class Path:
    """Properties of the link of one host of a machine, in both directions; times in seconds, shares 0 to 1.

    Attributes:
        jitter: maximum of a random delay that is added, so that datagrams overtake each other.
        cut, cut_back: whether nothing passes in both directions, or in that to the host.
        lost, duplicated, carried: number of datagrams, without those that a cut lost.
    """

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    duplication: float = 0.0
    cut: bool = False
    cut_back: bool = False
    lost: int = 0
    duplicated: int = 0
    carried: int = 0
    drops: int = 0
    random: Random = field(default_factory=Random)


_NO_PATH = Path()


@dataclass(order=True)
class _Event:
    at: float
    order: int
    action: Callable[[], None] = field(compare=False)


class SimulatedNetwork:
    """Machines, links and the clock.

    Args:
        seed: of all random delays and losses.

    Attributes:
        now: current time, seconds.
        recorded: datagrams that arrived at a socket, with their sources, while `recording`.
    """

    def __init__(self, seed: int = 1) -> None:
        self.now = 1000.0
        self.recording = False
        self.recorded: list[tuple[Endpoint, bytes]] = []
        self._seed = seed
        self._events: list[_Event] = []
        self._order = itertools.count()
        self._numbers, self._ports = itertools.count(1000), itertools.count(40000)
        self._paths: dict[str, Path] = {}
        self._sockets: dict[Endpoint, SimulatedSocket] = {}
        self._public: dict[Endpoint, Endpoint] = {}  # source addresses behind a NAT, and what others see
        self._private: dict[Endpoint, Endpoint] = {}

    def clock(self) -> float:
        """Current time, seconds."""
        return self.now

    def machine(self, *hosts: str) -> Machine:
        """Create a machine with these addresses."""
        return Machine(self, hosts)

    def path(self, host: str) -> Path:
        """Link of a host."""
        if host not in self._paths:
            self._paths[host] = Path(random=Random(f"{self._seed} {host}"))
        return self._paths[host]

    def rebind(self, host: str) -> None:
        """Give all sockets of a host other source ports, as a NAT that lost its mappings; the old ports are gone."""
        for near in [near for near in {*self._sockets, *self._public} if near[0] == host]:
            self._private.pop(self._public.pop(near, near), None)
            far = self._public[near] = (host, next(self._ports))
            self._private[far] = near

    def drop(self, host: str) -> None:
        """Lose all datagrams that are on their way from or to a host."""
        self.path(host).drops += 1

    def at(self, when: float, action: Callable[[], None]) -> None:
        """Call a function at a time."""
        heapq.heappush(self._events, _Event(max(when, self.now), next(self._order), action))

    def every(self, period: float, action: Callable[[], object]) -> Callable[[], None]:
        """Call a function periodically, from now on; returns a function that ends it."""
        going = [True]

        def call() -> None:
            if going:
                action()
                self.at(self.now + period, call)

        self.at(self.now, call)
        return going.clear

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self._events and self._events[0].at <= end:
            self._step()
        self.now = end

    def until(self, condition: Callable[[], Any], seconds: float = 60) -> float:
        """Let time pass until a condition is true; returns how long that took, in virtual seconds.

        Raises:
            TimeoutError: it was false for the whole time.
        """
        began = self.now
        while not condition():
            if not self._events or self._events[0].at > began + seconds:
                raise TimeoutError(f"not within {seconds:g} virtual seconds")
            self._step()
        return self.now - began

    def send(self, source: Endpoint, to: Endpoint, data: bytes) -> None:
        """Send a datagram; sources may be forged."""
        path = next((self._paths[host] for host in (source[0], to[0]) if host in self._paths), _NO_PATH)
        if path.cut or (path.cut_back and to[0] in self._paths):
            return
        handshake = bool(data) and data[0] in _HANDSHAKE_RECORDS
        if path.loss and not handshake and path.random.random() < path.loss:
            path.lost += 1
            return
        path.carried += 1
        copies = 1 + (path.duplication > 0 and not handshake and path.random.random() < path.duplication)
        path.duplicated += copies - 1
        seen, drops = self._public.get(source, source), path.drops
        for _ in range(copies):
            delay = path.delay + (path.jitter * path.random.random() if path.jitter and not handshake else 0.0)
            self.at(self.now + delay, lambda: self._arrive(seen, to, data) if path.drops == drops else None)

    def _arrive(self, source: Endpoint, to: Endpoint, data: bytes) -> None:
        if self.recording:
            self.recorded.append((source, data))
        if to in self._public:  # the NAT has another port for that socket now
            return
        if (sock := self._sockets.get(self._private.get(to, to))) is not None:
            sock.arrive(data, source)

    def _step(self) -> None:
        event = heapq.heappop(self._events)
        self.now = event.at
        event.action()

    def open(self, sock: SimulatedSocket) -> None:
        """Deliver to this socket from now on."""
        self._sockets[sock.local] = sock

    def close(self, sock: SimulatedSocket) -> None:
        """Deliver nothing to this socket from now on."""
        self._sockets.pop(sock.local, None)

    def free_port(self) -> int:
        """A port that no socket uses."""
        return next(self._ports)

    def free_number(self) -> int:
        """A number that no socket has."""
        return next(self._numbers)

    def is_used(self, address: Endpoint) -> bool:
        """Whether a socket is bound to an address."""
        return address in self._sockets


class Machine:
    """A machine with its addresses; it does nothing while it stalls.

    Attributes:
        hosts: its IP addresses.
    """

    def __init__(self, network: SimulatedNetwork, hosts: tuple[str, ...]) -> None:
        self.network, self.hosts = network, hosts
        self._stalled_until = float("-inf")
        self._waiting: deque[Callable[[], None]] = deque()

    def reactor(
        self, received: Callable[[Any, bytes, Address], None], tick: Callable[[float], None], clock: Callable[[], float]
    ) -> SimulatedReactor:
        """Open a reactor; see `UdpReactor`."""
        return SimulatedReactor(self, received, tick, clock)

    def stall(self, seconds: float) -> None:
        """Do nothing for some time from now on; what happens meanwhile is handled, in order, at its end."""
        self._stalled_until = max(self._stalled_until, self.network.now + seconds)
        self.network.at(self._stalled_until, self._resume)

    def do(self, action: Callable[[], None]) -> None:
        """Call a function now, or once a stall ends."""
        if self.network.now < self._stalled_until or self._waiting:
            self._waiting.append(action)
        else:
            action()

    def every(self, period: float, action: Callable[[], object]) -> Callable[[], None]:
        """Call a function periodically unless the machine stalls; returns a function that ends it."""
        going = [True]

        def call() -> None:
            if going:
                action()
                self.network.at(self.network.now + period, partial(self.do, call))

        self.do(call)
        return going.clear

    def _resume(self) -> None:
        while self._waiting and self.network.now >= self._stalled_until:
            self._waiting.popleft()()


class SimulatedSocket:
    """A UDP socket of a machine."""

    def __init__(self, reactor: SimulatedReactor, local: Endpoint, remote: Endpoint | None) -> None:
        self.local, self.remote = local, remote
        self._reactor, self._network = reactor, reactor.machine.network
        self._number = self._network.free_number()
        self._queued = 0
        self._open = True
        self._network.open(self)

    def fileno(self) -> int:
        return self._number if self._open else -1

    def getsockname(self) -> Address:
        return self.local

    def send(self, data: bytes) -> int:
        assert self.remote is not None
        return self.sendto(data, self.remote)

    def sendto(self, data: bytes, address: Any) -> int:
        if not self._open:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        self._network.send(self.local, address, data)
        return len(data)

    def arrive(self, data: bytes, source: Endpoint) -> None:
        """Queue a datagram for the reactor; a connected socket receives only from its remote address."""
        if self.remote in (None, source) and self._queued < SOCKET_QUEUE_MAX:
            self._queued += 1
            self._reactor.machine.do(partial(self._deliver, data, source))

    def close(self) -> None:
        self._open = False
        self._network.close(self)

    def _deliver(self, data: bytes, source: Endpoint) -> None:
        self._queued -= 1
        if self._open:
            self._reactor.received(self, data, source)


class SimulatedReactor:
    """Reads sockets and calls a timer in virtual time; see `UdpReactor`."""

    def __init__(
        self,
        machine: Machine,
        received: Callable[[Any, bytes, Address], None],
        tick: Callable[[float], None],
        clock: Callable[[], float],
    ) -> None:
        self.machine, self.received = machine, received
        self._tick, self._clock = tick, clock
        self._sockets: set[SimulatedSocket] = set()
        self._callbacks: deque[Callable[[], None]] = deque()
        self._end_ticks: Callable[[], None] = lambda: None

    def bind(self, host: str, port: int) -> SimulatedSocket:
        address = (host, port or self.machine.network.free_port())
        if host not in self.machine.hosts:
            raise OSError(errno.EADDRNOTAVAIL, os.strerror(errno.EADDRNOTAVAIL))
        if self.machine.network.is_used(address):
            raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE))
        return self._add(SimulatedSocket(self, address, None))

    def connect(self, local: str, remote: Endpoint) -> SimulatedSocket:
        host = local or self.machine.hosts[0]
        if host not in self.machine.hosts:
            raise OSError(errno.EADDRNOTAVAIL, os.strerror(errno.EADDRNOTAVAIL))
        return self._add(SimulatedSocket(self, (host, self.machine.network.free_port()), remote))

    def remove(self, sock: UdpSocket) -> None:
        assert isinstance(sock, SimulatedSocket)
        self._sockets.remove(sock)
        sock.close()

    def call_soon(self, callback: Callable[[], None]) -> None:
        self._callbacks.append(callback)
        self.machine.network.at(self.machine.network.now, partial(self.machine.do, self._call))

    def start(self) -> None:
        self._end_ticks = self.machine.every(TICK_S, lambda: self._tick(self._clock()))

    def end(self) -> None:
        self._end_ticks()
        self._call()
        for sock in self._sockets:
            sock.close()

    def _call(self) -> None:
        while self._callbacks:
            self._callbacks.popleft()()

    def _add(self, sock: SimulatedSocket) -> SimulatedSocket:
        self._sockets.add(sock)
        return sock
