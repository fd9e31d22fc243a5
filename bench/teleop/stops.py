"""All links of a vehicle cut, again and again: when its translator brakes; clocks that are wrong (of `bench.teleop`).

Many pairs at once, some a process; between vehicle and station is a network in this program, as in the tests.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import random
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from scan2sim.services.teleoperation.control.controls import Controls
from scan2sim.services.teleoperation.control.messages import Kind, Message, Telemetry
from scan2sim.services.teleoperation.control.safety import LIMIT_MS
from scan2sim.services.teleoperation.gateway.identity import Role
from scan2sim.services.teleoperation.qos.scripted_drive import EVERY, Plain, Route
from scan2sim.services.teleoperation.transport.clock_sync import Clocks
from scan2sim.services.teleoperation.transport.multipath import Bundle
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.vehicle_side import Link, dial
from scan2sim.services.teleoperation.vehicle.adapter import TranslateParams, Translating
from scan2sim.services.teleoperation.vehicle.onboard_unit import CarParams, CarUnit
from tests.services.teleoperation.certificates import identity
from tests.services.teleoperation.transport.relay import Relay

Say = Callable[[str], None]
HOSTS = ("127.0.0.1", "127.0.0.2")
ALLOWED = 50.0
"""Milliseconds beyond the limit."""
PROCESSES, PAIRS = 2, 4
"""And pairs of each."""
WRONG, WITHIN = 10.0, 3.0
"""Seconds that a wall clock is set wrong by; that its driver tries to drive nevertheless."""
PATIENCE = 20.0
"""Seconds within which a pair is to drive again, and to brake."""


class Braking(Plain):
    """Notes when it is told to drive, and when to brake."""

    def __init__(self) -> None:
        super().__init__()
        self.drives, self.since = False, time.monotonic()

    def obey(self, controls: Controls) -> None:
        """See `translators.Vehicle`."""
        super().obey(controls)
        drives = controls.brake < 1.0
        if drives != self.drives:
            self.drives, self.since = drives, time.monotonic()


class Stopped:
    """A pair whose links are cut; `apart`: seconds that the vehicle's and the station's wall clocks are wrong by."""

    def __init__(self, seed: int, apart: tuple[float, float] = (0.0, 0.0)) -> None:
        self._chance, self._ended, self._told = random.Random(seed), threading.Event(), list[Telemetry]()
        car, desk = identity(Role.VEHICLE, "car"), identity(Role.STATION, "desk")
        self._listener = Listener(desk, [(HOSTS[0], 0)])
        self._relay = Relay((HOSTS[0], self._listener.port), seed)
        for host in HOSTS:
            shape = self._relay.shapes[host]
            shape.delay, shape.jitter, shape.loss = 0.03, 0.02, 0.01
        self._vehicle = Braking()
        translating = Translating(self._vehicle, TranslateParams(port=0))
        host, port = translating.address
        self._unit = CarUnit(CarParams(translator=f"{host}:{port}"))
        links = [Link(host, host) for host in HOSTS]
        clocks = [Clocks(wall=partial(_wall, wrong)) for wrong in apart]
        self._bundle = self._listener.expect(car.me, self._received, clocks=clocks[1])

        def dialled(received: Callable[[Message], None], began: Callable[[], None]) -> Bundle:
            remote = [self._relay.address]
            return dial(car, desk.me, links, remote, received=received, began=began, clocks=clocks[0])

        self._unit.join(dialled)
        self._threads = [
            threading.Thread(target=partial(translating.run, self._ended), daemon=True),
            threading.Thread(target=self._drive, daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> float | None:
        """Cut all links while it drives, then restore them; ms until it braked, None: it didn't, or went on by itself.

        Raises:
            TimeoutError: it didn't drive.
        """
        vehicle = self._vehicle
        if not self._until(
            lambda: vehicle.drives and time.monotonic() > vehicle.since + self._chance.uniform(0.1, 0.4)
        ):
            raise TimeoutError("a pair doesn't drive again")
        self._cut(True)
        began = time.monotonic()
        braked = self._until(lambda: not vehicle.drives)
        took = (vehicle.since - began) * 1e3
        time.sleep(self._chance.choice((0.05, 0.1, 0.2, 0.2, 1.5)))
        stays = not vehicle.drives
        self._cut(False)
        return took if braked and stays else None

    def noticed(self) -> str:
        """What vehicle and station say of their clocks while a driver tries; nothing: one said nothing, or it drove."""
        wrong = self._bundle.clocks
        both = self._until(lambda: wrong.wall_wrong and bool(self._told) and "NTP" in self._told[0].reason)
        end = time.monotonic() + WITHIN
        while time.monotonic() < end and not self._vehicle.drives:
            time.sleep(0.01)
        return self._told[0].reason if both and not self._vehicle.drives else ""

    def close(self) -> None:
        """End."""
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._unit.close()
        self._listener.close()
        self._relay.close()

    def _cut(self, cut: bool) -> None:
        for host in HOSTS:
            self._relay.shapes[host].cut = cut

    def _received(self, message: Message) -> None:
        if message.kind == Kind.TELEMETRY:
            self._told[:] = [Telemetry.unpack(message.body)]

    def _drive(self) -> None:
        route = Route()
        while not self._ended.wait(EVERY):
            if self._told:
                self._bundle.send(Kind.COMMAND, route.command(self._told[0], time.monotonic()).pack())

    @staticmethod
    def _until(true: Callable[[], bool]) -> bool:
        end = time.monotonic() + PATIENCE
        while not (found := true()) and time.monotonic() < end:
            time.sleep(0.005)
        return found


def _wall(wrong: float) -> int:
    return time.time_ns() + round(wrong * 1e9)


def clocks(scale: float, say: Say) -> dict[str, Any]:
    """A wall clock of either side is wrong, to either side; a driver tries to drive, and both are to notice before."""
    tries, noticed = [(wrong, side) for wrong in (WRONG, -WRONG) for side in ("vehicle", "station")], 0
    for wrong, side in tries:
        pair = Stopped(1, (wrong, 0.0) if side == "vehicle" else (0.0, wrong))
        told = pair.noticed()
        pair.close()
        noticed += bool(told)
        say(f"the {side}'s clock {wrong:+.0f} s: {told or 'NOT NOTICED'}")
    return {"wrong_clocks": len(tries), "wrong_clocks_noticed": noticed}


def _pairs(each: int, seed: int, pipe: multiprocessing.connection.Connection) -> None:
    """The process of some pairs; tells each stop."""

    def one(number: int) -> None:
        stopped = Stopped(seed + number)
        try:
            for _ in range(each):
                took = stopped.stop()
                with lock:
                    pipe.send(took)
        finally:
            stopped.close()

    lock = threading.Lock()
    threads = [threading.Thread(target=one, args=(number,)) for number in range(PAIRS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    pipe.close()


def stops(scale: float, say: Say) -> dict[str, Any]:
    """So many stops, of all pairs."""
    each = max(3, round(1000 * scale / PROCESSES / PAIRS))
    spawn = multiprocessing.get_context("spawn")
    pipes, processes = list[multiprocessing.connection.Connection](), list[Any]()
    for number in range(PROCESSES):
        here, there = spawn.Pipe(duplex=False)
        processes.append(spawn.Process(target=_pairs, args=(each, number * 1000, there), daemon=True))
        processes[-1].start()
        there.close()
        pipes.append(here)
    taken = list[float | None]()
    while pipes:
        for pipe in multiprocessing.connection.wait(pipes):
            assert isinstance(pipe, multiprocessing.connection.Connection)
            try:
                taken.append(pipe.recv())
            except EOFError:
                pipes.remove(pipe)
                continue
            if len(taken) % 100 == 0:
                say(f"{len(taken)} stops")
    for process in processes:
        process.join()
    times = sorted(one for one in taken if one is not None)
    expected = each * PROCESSES * PAIRS
    if times:
        middle, last = times[len(times) // 2], times[-1]
        say(
            f"stops: {len(taken)} of {expected}, half within {middle:.0f} ms, all within {last:.0f}; limit {LIMIT_MS:g}"
        )
    in_time = sum(one <= LIMIT_MS + ALLOWED for one in times)
    return {"stops": expected, "stops_in_time": in_time}
