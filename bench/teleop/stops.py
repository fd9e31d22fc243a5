"""Repeated loss of all links of a vehicle: time until its adapter brakes; and wrong clocks (parts of `bench.teleop`).

Many pairs run at once in a few processes; the network between vehicle and station is emulated in the process.
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
from scan2sim.services.teleoperation.control.safety import COMMAND_MAX_AGE_MS
from scan2sim.services.teleoperation.identity import Role
from scan2sim.services.teleoperation.qos.scripted_drive import COMMAND_PERIOD_S, PlainCar, ScriptedCommands
from scan2sim.services.teleoperation.settings import OnboardParams
from scan2sim.services.teleoperation.transport.clock_sync import ClockSync
from scan2sim.services.teleoperation.transport.multipath import MultipathConnection
from scan2sim.services.teleoperation.transport.station_side import Listener
from scan2sim.services.teleoperation.transport.vehicle_side import Link, connect_station
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams, AdapterServer
from scan2sim.services.teleoperation.vehicle.onboard_unit import OnboardUnit
from tests.fakes.certificates import identity
from tests.fakes.relay import Relay
from tests.fakes.vehicle import adapter_key_file

Report = Callable[[str], None]
HOSTS = ("127.0.0.1", "127.0.0.2")
TOLERANCE_MS = 50.0
"""Tolerance beyond the limit."""
PROCESSES, PAIRS_PER_PROCESS = 2, 4
CLOCK_ERROR_S, DRIVE_ATTEMPT_S = 10.0, 3.0
"""Error of a wall clock, and how long the driver tries to drive nevertheless."""
STATE_TIMEOUT_S = 20.0
"""Time within which a pair must drive again, or brake."""


class BrakeMonitor(PlainCar):
    """Vehicle that records when it is commanded to drive and when to brake."""

    def __init__(self) -> None:
        super().__init__()
        self.drives, self.since = False, time.monotonic()

    def obey(self, controls: Controls) -> None:
        """See `adapters.Vehicle`."""
        super().obey(controls)
        drives = controls.brake < 1.0
        if drives != self.drives:
            self.drives, self.since = drives, time.monotonic()


class InterruptedPair:
    """A pair whose links are cut; `clock_errors`: errors of the vehicle's and the station's wall clocks, s."""

    def __init__(self, seed: int, clock_errors: tuple[float, float] = (0.0, 0.0)) -> None:
        self._chance, self._ended, self._telemetry = random.Random(seed), threading.Event(), list[Telemetry]()
        car, desk = identity(Role.VEHICLE, "car"), identity(Role.STATION, "desk")
        self._listener = Listener(desk, [(HOSTS[0], 0)])
        self._relay = Relay((HOSTS[0], self._listener.port), seed)
        for host in HOSTS:
            shape = self._relay.shapes[host]
            shape.delay, shape.jitter, shape.loss = 0.03, 0.02, 0.01
        self._vehicle = BrakeMonitor()
        adapter_server = AdapterServer(self._vehicle, AdapterParams(port=0, key=adapter_key_file()))
        host, port = adapter_server.address
        self._unit = OnboardUnit(OnboardParams(adapter=f"{host}:{port}", key=adapter_key_file()))
        links = [Link(host, host) for host in HOSTS]
        clocks = [ClockSync(wall=partial(_wall, wrong)) for wrong in clock_errors]
        self._connection = self._listener.expect(car.me, self._received, clocks=clocks[1])

        def connect(received: Callable[[Message], None], began: Callable[[], None]) -> MultipathConnection:
            remote = [self._relay.address]
            return connect_station(car, desk.me, links, remote, received=received, restarted=began, clocks=clocks[0])

        self._unit.join(connect)
        self._threads = [
            threading.Thread(target=partial(adapter_server.run, self._ended), daemon=True),
            threading.Thread(target=self._drive, daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> float | None:
        """Cut all links while it drives, then restore them; ms until it braked, None: it didn't, or resumed by itself.

        Raises:
            TimeoutError: it doesn't drive.
        """
        vehicle = self._vehicle
        if not self._until(
            lambda: vehicle.drives and time.monotonic() > vehicle.since + self._chance.uniform(0.1, 0.4)
        ):
            raise TimeoutError("a pair doesn't resume driving")
        self._cut(True)
        began = time.monotonic()
        braked = self._until(lambda: not vehicle.drives)
        took = (vehicle.since - began) * 1e3
        time.sleep(self._chance.choice((0.05, 0.1, 0.2, 0.2, 1.5)))
        stays = not vehicle.drives
        self._cut(False)
        return took if braked and stays else None

    def clock_warning(self) -> str:
        """Warning of vehicle and station about their clocks while a driver tries to drive; empty if one is missing."""
        wrong = self._connection.clocks
        both = self._until(lambda: wrong.wall_wrong and bool(self._telemetry) and "NTP" in self._telemetry[0].reason)
        end = time.monotonic() + DRIVE_ATTEMPT_S
        while time.monotonic() < end and not self._vehicle.drives:
            time.sleep(0.01)
        return self._telemetry[0].reason if both and not self._vehicle.drives else ""

    def close(self) -> None:
        """Stop the pair."""
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
            self._telemetry[:] = [Telemetry.unpack(message.body)]

    def _drive(self) -> None:
        route = ScriptedCommands()
        while not self._ended.wait(COMMAND_PERIOD_S):
            if self._telemetry:
                self._connection.send(Kind.COMMAND, route.command(self._telemetry[0], time.monotonic()).pack())

    @staticmethod
    def _until(true: Callable[[], bool]) -> bool:
        end = time.monotonic() + STATE_TIMEOUT_S
        while not (found := true()) and time.monotonic() < end:
            time.sleep(0.005)
        return found


def _wall(wrong: float) -> int:
    return time.time_ns() + round(wrong * 1e9)


def clocks(scale: float, report: Report) -> dict[str, Any]:
    """A wrong wall clock at either side, in both directions; both sides must warn before the vehicle drives."""
    cases = [(wrong, side) for wrong in (CLOCK_ERROR_S, -CLOCK_ERROR_S) for side in ("vehicle", "station")]
    noticed = 0
    for wrong, side in cases:
        pair = InterruptedPair(1, (wrong, 0.0) if side == "vehicle" else (0.0, wrong))
        warning = pair.clock_warning()
        pair.close()
        noticed += bool(warning)
        report(f"the {side}'s clock {wrong:+.0f} s: {warning or 'NO WARNING'}")
    return {"wrong_clocks": len(cases), "wrong_clocks_noticed": noticed}


def _pairs(each: int, seed: int, pipe: multiprocessing.connection.Connection) -> None:
    """Process of some pairs; sends the result of each stop."""

    def one(number: int) -> None:
        pair = InterruptedPair(seed + number)
        try:
            for _ in range(each):
                took = pair.stop()
                with lock:
                    pipe.send(took)
        finally:
            pair.close()

    lock = threading.Lock()
    threads = [threading.Thread(target=one, args=(number,)) for number in range(PAIRS_PER_PROCESS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    pipe.close()


def stops(scale: float, report: Report) -> dict[str, Any]:
    """Stops of all pairs."""
    each = max(3, round(1000 * scale / PROCESSES / PAIRS_PER_PROCESS))
    spawn = multiprocessing.get_context("spawn")
    pipes, processes = list[multiprocessing.connection.Connection](), list[Any]()
    for number in range(PROCESSES):
        parent_end, child_end = spawn.Pipe(duplex=False)
        processes.append(spawn.Process(target=_pairs, args=(each, number * 1000, child_end), daemon=True))
        processes[-1].start()
        child_end.close()
        pipes.append(parent_end)
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
                report(f"{len(taken)} stops")
    for process in processes:
        process.join()
    times = sorted(one for one in taken if one is not None)
    expected = each * PROCESSES * PAIRS_PER_PROCESS
    if times:
        middle, last = times[len(times) // 2], times[-1]
        report(
            f"stops: {len(taken)} of {expected}, half within {middle:.0f} ms, all within {last:.0f}; "
            f"limit {COMMAND_MAX_AGE_MS:g}"
        )
    in_time = sum(one <= COMMAND_MAX_AGE_MS + TOLERANCE_MS for one in times)
    return {"stops": expected, "stops_in_time": in_time}
