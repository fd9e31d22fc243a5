"""The fleet: connected vehicles and stations, which station drives which vehicle, and changes of it (D3.2, 4.3).

Only the gateway decides on pairs. A pair is stored on disk before its parties are notified, and sent again to a party
that reconnects; so a restarted gateway finds its pairs driving. A vehicle, and a station, is in one pair at most.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from scan2sim.pipeline.core.errors import BusyError, InputError, SettingError, from_os_error
from scan2sim.services.teleoperation.gateway.audit import AuditTrail
from scan2sim.services.teleoperation.gateway_protocol import (
    CurrentPair,
    DriverEvent,
    DriverRequest,
    Hello,
    Join,
    PairMember,
    Release,
    RequestRejected,
    Status,
)
from scan2sim.services.teleoperation.identity import Peer, Role

Order = Join | Release | RequestRejected
Send = Callable[[Order], None]
GATEWAY_AUTHOR = "gateway"
"""Author of a change that nobody requested."""


@dataclass(frozen=True)
class Pair:
    """A station that drives a vehicle.

    Attributes:
        number: counts all pairs that ever existed.
        since: Unix time, seconds.
        by: who requested it.
        before: station that drove the vehicle before it was handed over.
    """

    number: int
    vehicle: str
    station: str
    since: float
    by: str
    before: str | None = None


@dataclass
class _Party:
    """A party that has connected since the gateway's start."""

    peer: Peer
    hello: Hello
    address: str
    send: Send | None
    since: float
    status: Status = field(default_factory=Status)
    status_at: float = -math.inf  # when it arrived, seconds of the monotonic clock
    driver_since: float | None = None  # Unix time at which the driver of a station took control


_STATE = TypeAdapter(tuple[int, tuple[Pair, ...]])


class Fleet:
    """Parties and pairs; all methods are thread-safe."""

    def __init__(self, folder: Path, *, now: Callable[[], float] = time.time) -> None:
        """Restore the pairs stored in a folder.

        Raises:
            InputError: the stored state is damaged. SpaceError: the folder can't be written to.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise from_os_error(error, folder) from None
        self._file, self._now, self._lock = folder / "fleet.json", now, threading.RLock()
        self.audit = AuditTrail(folder / "audit.jsonl")
        self._parties: dict[tuple[Role, str], _Party] = {}
        self._last_number, self._pairs = self._read()

    # connections of parties

    def connected(self, peer: Peer, hello: Hello, address: str, send: Send) -> None:
        """Register a party that connected, and send it its pair, or that it is in none.

        Args:
            address: address of the party.
            send: sends it an order; must not block. Replaces that of an earlier connection of this party.
        """
        with self._lock:
            self._parties[peer.role, peer.name] = _Party(peer, hello, address, send, self._now())
            self._restore(peer, hello.driving)
            pair = self._pair_of(peer.role, peer.name)
            if pair is None:
                send(Release(why="it is in no pair"))
            else:
                self._send_pair(pair)

    def update_status(self, peer: Peer, status: Status) -> None:
        """Store a party's status."""
        with self._lock:
            party = self._parties[peer.role, peer.name]
            before = party.status
            if not status.driver:
                party.driver_since = None
            elif status.driver != before.driver or status.held < before.held:
                party.driver_since = self._now() - status.held
            party.status, party.status_at = status, time.monotonic()

    def handle_request(self, peer: Peer, request: DriverRequest) -> None:
        """Carry out a request of a station's driver, for that station only."""
        if peer.role != Role.STATION:
            raise SettingError(peer.name, "is not a station", "Send requests from a station, or use the fleet page")
        by = f"{request.driver} at {peer.name}" if request.driver else peer.name
        if request.what == "join":
            self.join(request.vehicle, peer.name, by)
            return
        with self._lock:
            pair = self._require_pair(request.vehicle)
            if pair.station != peer.name:
                remedy = "Release it there, or on the fleet page"
                raise BusyError(request.vehicle, f"is driven from {pair.station}", remedy)
            self.release(request.vehicle, by)

    def log_event(self, peer: Peer, event: DriverEvent) -> None:
        """Log what a station's driver did; events of other parties are ignored."""
        if peer.role != Role.STATION:
            return
        with self._lock:
            pair = self._pair_of(Role.STATION, peer.name)
            entry = {
                "what": event.what,
                "vehicle": pair.vehicle if pair else "",
                "station": peer.name,
                "by": event.driver,
            }
            self.audit.add({"time": round(self._now(), 3), "happened": event.time, **entry})

    def disconnected(self, peer: Peer, send: Send) -> None:
        """Unregister a party's connection; its pair stays."""
        with self._lock:
            party = self._parties.get((peer.role, peer.name))
            if party is not None and party.send == send:
                party.send, party.since, party.status, party.driver_since = None, self._now(), Status(), None

    # changes of pairs

    def join(self, vehicle: str, station: str, by: str) -> Pair:
        """Let a station drive a vehicle.

        Raises:
            SettingError: one of them isn't connected. BusyError: one of them is in a pair.
            SpaceError: the pair can't be stored.
        """
        with self._lock:
            self._check_available(vehicle, station)
            if (pair := self._pairs.get(vehicle)) is not None:
                raise BusyError(vehicle, f"is driven from {pair.station}", "Release it, or hand it over")
            return self._change("join", Pair(self._last_number + 1, vehicle, station, self._now(), by))

    def hand_over(self, vehicle: str, station: str, by: str) -> Pair:
        """Let another station drive a vehicle; its driver has to confirm before the vehicle moves.

        Raises:
            SettingError: one of them isn't connected, or the vehicle is in no pair.
            BusyError: the station drives another vehicle. SpaceError: the pair can't be stored.
        """
        with self._lock:
            before = self._require_pair(vehicle)
            self._check_available(vehicle, station)
            pair = Pair(self._last_number + 1, vehicle, station, self._now(), by, before.station)
            self._change("hand over", pair)
            self._send_order(Role.STATION, before.station, Release(why=f"{by} handed {vehicle} over to {station}"))
            return pair

    def take_back(self, vehicle: str, by: str) -> Pair:
        """Give a vehicle back to the station that drove it before the handover; raises as `hand_over`."""
        with self._lock:
            before = self._require_pair(vehicle).before
            if before is None:
                raise SettingError(vehicle, "was not handed over", "Hand it over to a station by name")
            return self.hand_over(vehicle, before, by)

    def release(self, vehicle: str, by: str) -> None:
        """End a vehicle's pair; the vehicle stops.

        Raises:
            SettingError: it is in no pair. SpaceError: the change can't be stored.
        """
        with self._lock:
            pair = self._require_pair(vehicle)
            self._log("release", pair, by)
            self._write(self._last_number, {k: v for k, v in self._pairs.items() if k != vehicle})
            for role, name in ((Role.VEHICLE, vehicle), (Role.STATION, pair.station)):
                self._send_order(role, name, Release(why=f"{by} released {vehicle}"))

    # state for the page

    def snapshot(self) -> dict[str, Any]:
        """All parties and their pairs, for the page and its API.

        `driver` is who has control of a vehicle, or at a station, and `driver_since` since when (Unix time, seconds).
        """
        with self._lock:
            of_station = {pair.station: pair for pair in self._pairs.values()}
            parties = sorted(self._parties.values(), key=lambda one: one.peer.name)
            result: dict[str, list[dict[str, Any]]] = {"vehicles": [], "stations": []}
            for one in parties:
                pairs = self._pairs if one.peer.role == Role.VEHICLE else of_station
                pair = pairs.get(one.peer.name)
                station = None if pair is None else self._parties.get((Role.STATION, pair.station))
                result["vehicles" if one.peer.role == Role.VEHICLE else "stations"].append(
                    {
                        "name": one.peer.name, "connected": one.send is not None, "since": one.since,
                        "address": one.address, "cameras": one.hello.cameras,
                        "pair": None if pair is None else pair.number,
                        "other": None if pair is None else pair.station if pairs is self._pairs else pair.vehicle,
                        "before": None if pair is None else pair.before,
                        **one.status.model_dump(exclude={"kind", "pair", "speed", "driver", "held"}),
                        "driver": "" if station is None else station.status.driver,
                        "driver_since": None if station is None else station.driver_since,
                    }
                )  # fmt: skip
            return result

    def speeds(self) -> dict[str, dict[str, float | None]]:
        """Speed (m/s) of each vehicle and time since its report arrived (`reported_ms`, ms); None: unknown."""
        now = time.monotonic()
        with self._lock:
            vehicles = [one for one in self._parties.values() if one.peer.role == Role.VEHICLE and one.send is not None]
            return {
                one.peer.name: {"speed": one.status.speed, "reported_ms": round(1e3 * (now - one.status_at), 1)}
                for one in vehicles
                if one.status.speed is not None
            }

    # internals

    def _pair_of(self, role: Role, name: str) -> Pair | None:
        if role == Role.VEHICLE:
            return self._pairs.get(name)
        return next((pair for pair in self._pairs.values() if pair.station == name), None)

    def _require_pair(self, vehicle: str) -> Pair:
        if vehicle not in self._pairs:
            raise SettingError(vehicle, "is not driven by any station", "Join it with a station first")
        return self._pairs[vehicle]

    def _check_available(self, vehicle: str, station: str) -> None:
        """Check that both are connected, and that the station drives no vehicle."""
        for role, name in ((Role.VEHICLE, vehicle), (Role.STATION, station)):
            party = self._parties.get((role, name))
            if party is None or party.send is None:
                raise SettingError(name, f"is not a connected {role}", "Start it, and check that it connects")
        if (pair := self._pair_of(Role.STATION, station)) is not None:
            raise BusyError(station, f"drives {pair.vehicle}", "Release that vehicle first")

    def _restore(self, peer: Peer, driving: CurrentPair | None) -> None:
        """Restore a pair unknown to the gateway, if vehicle and station both report that they are in it."""
        if driving is None:
            return
        role = Role.STATION if peer.role == Role.VEHICLE else Role.VEHICLE
        other = self._parties.get((role, driving.other))
        reported = None if other is None or other.send is None else other.hello.driving
        if reported is None or (reported.pair, reported.other) != (driving.pair, peer.name):
            return
        vehicle, station = (peer.name, driving.other) if peer.role == Role.VEHICLE else (driving.other, peer.name)
        if driving.pair > self._last_number and self._pair_of(Role.VEHICLE, vehicle) is None is self._pair_of(
            Role.STATION, station
        ):
            self._change("found driving", Pair(driving.pair, vehicle, station, self._now(), GATEWAY_AUTHOR))

    def _change(self, what: str, pair: Pair) -> Pair:
        """Store a pair, then notify both parties."""
        self._log(what, pair, pair.by)
        self._write(pair.number, {**self._pairs, pair.vehicle: pair})
        self._send_pair(pair)
        return pair

    def _send_pair(self, pair: Pair) -> None:
        """Send a pair to both of its parties, if connected."""
        vehicle = self._parties.get((Role.VEHICLE, pair.vehicle))
        station = self._parties.get((Role.STATION, pair.station))
        for to, other in ((vehicle, station), (station, vehicle)):
            if to is not None and to.send is not None and other is not None:
                member = PairMember(name=other.peer.name, fingerprint=other.peer.fingerprint)
                to.send(Join(pair=pair.number, other=member, listening=other.hello.listening))

    def _send_order(self, role: Role, name: str, order: Order) -> None:
        party = self._parties.get((role, name))
        if party is not None and party.send is not None:
            party.send(order)

    def _log(self, what: str, pair: Pair, by: str) -> None:
        entry = {"what": what, "vehicle": pair.vehicle, "station": pair.station, "pair": pair.number, "by": by}
        self.audit.add({"time": round(self._now(), 3), **entry})

    def _read(self) -> tuple[int, dict[str, Pair]]:
        try:
            last, pairs = _STATE.validate_json(self._file.read_bytes())
        except FileNotFoundError:
            return 0, {}
        except (OSError, ValidationError) as error:
            remedy = "Delete it: pairs that are driving are restored when both parties reconnect"
            raise InputError(self._file, f"can't be read ({error!s:.100})", remedy) from None
        return last, {pair.vehicle: pair for pair in pairs}

    def _write(self, last: int, pairs: dict[str, Pair]) -> None:
        temporary = self._file.with_suffix(".new")
        try:
            with temporary.open("wb") as file:
                file.write(_STATE.dump_json((last, tuple(pairs.values())), indent=1))
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(self._file)
        except OSError as error:
            raise from_os_error(error, self._file) from None
        self._last_number, self._pairs = last, pairs
