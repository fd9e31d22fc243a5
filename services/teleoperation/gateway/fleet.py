"""The fleet: which vehicles and stations are there, who drives whom, and how that changes (D3.2, section 4.3).

Who is in a pair is decided here alone, kept on disk before anybody is told, and told again to whoever comes back: a
gateway that starts anew finds its pairs driving. A vehicle is in one pair at most, a station too.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from scan2sim.pipeline.core.errors import BusyError, InputError, SettingError, from_os_error
from scan2sim.services.teleoperation.gateway.audit import Audit
from scan2sim.services.teleoperation.gateway.identity import Peer, Role
from scan2sim.services.teleoperation.gateway.protocol import Ask, Driving, Hello, Join, Member, Refused, Release, Status

Order = Join | Release | Refused
Send = Callable[[Order], None]
GATEWAY = "gateway"
"""Who changes a pair where nobody has asked for it."""


@dataclass(frozen=True)
class Pair:
    """A station that drives a vehicle.

    Attributes:
        number: counts all pairs that ever were.
        since: seconds since 1970.
        by: who wanted it.
        before: the station that had the vehicle before it was handed over.
    """

    number: int
    vehicle: str
    station: str
    since: float
    by: str
    before: str | None = None


@dataclass
class _Party:
    """Who has been there since the gateway's start."""

    peer: Peer
    hello: Hello
    address: str
    send: Send | None
    since: float
    status: Status = field(default_factory=Status)


_KEPT = TypeAdapter(tuple[int, tuple[Pair, ...]])


class Fleet:
    """See the module; all methods may be called from any thread."""

    def __init__(self, folder: Path, *, now: Callable[[], float] = time.time) -> None:
        """Go on from what is kept in a folder.

        Raises:
            InputError: what is kept there is damaged. SpaceError: it can't be written to.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise from_os_error(error, folder) from None
        self._file, self._now, self._lock = folder / "fleet.json", now, threading.RLock()
        self.audit = Audit(folder / "audit.jsonl")
        self._parties: dict[tuple[Role, str], _Party] = {}
        self._last, self._pairs = self._read()

    # parties come, tell and go

    def came(self, peer: Peer, hello: Hello, address: str, send: Send) -> None:
        """A party is connected; it is told the pair that it is to be in, or that it is in none.

        Args:
            address: that it came from.
            send: gives it an order; never blocks. Who was connected by its name before is sent no more.
        """
        with self._lock:
            self._parties[peer.role, peer.name] = _Party(peer, hello, address, send, self._now())
            self._adopt(peer, hello.driving)
            pair = self._of(peer.role, peer.name)
            if pair is None:
                send(Release(why="it is in no pair"))
            else:
                self._tell(pair)

    def told(self, peer: Peer, status: Status) -> None:
        """A party says how it is."""
        with self._lock:
            self._parties[peer.role, peer.name].status = status

    def asked(self, peer: Peer, ask: Ask) -> None:
        """A station's driver asks for itself; whoever else would be changed by it isn't."""
        if peer.role != Role.STATION:
            raise SettingError(peer.name, "is no station, and asks for nothing", "Ask from a station, or the page")
        if ask.what == "join":
            self.join(ask.vehicle, peer.name, peer.name)
            return
        with self._lock:
            pair = self._pair(ask.vehicle)
            if pair.station != peer.name:
                raise BusyError(ask.vehicle, f"is driven from {pair.station}", "Ask there, or on the gateway's page")
            self.release(ask.vehicle, peer.name)

    def left(self, peer: Peer, send: Send) -> None:
        """A party's connection has ended; its pair stays."""
        with self._lock:
            party = self._parties.get((peer.role, peer.name))
            if party is not None and party.send is send:
                party.send, party.since, party.status = None, self._now(), Status()

    # pairs change

    def join(self, vehicle: str, station: str, by: str) -> Pair:
        """Have a station drive a vehicle.

        Raises:
            SettingError: one of them isn't there. BusyError: one of them is in a pair.
            SpaceError: it can't be kept.
        """
        with self._lock:
            self._free(vehicle, station)
            if (pair := self._pairs.get(vehicle)) is not None:
                raise BusyError(vehicle, f"is driven from {pair.station}", "Release it, or hand it over")
            return self._change("join", Pair(self._last + 1, vehicle, station, self._now(), by))

    def hand_over(self, vehicle: str, station: str, by: str) -> Pair:
        """Have another station drive a vehicle; its driver has to confirm before it moves.

        Raises:
            SettingError: one of them isn't there, or the vehicle is in no pair.
            BusyError: the station drives another. SpaceError: it can't be kept.
        """
        with self._lock:
            before = self._pair(vehicle)
            self._free(vehicle, station)
            made = Pair(self._last + 1, vehicle, station, self._now(), by, before.station)
            self._change("hand over", made)
            self._order(Role.STATION, before.station, Release(why=f"{by} handed {vehicle} over to {station}"))
            return made

    def take_back(self, vehicle: str, by: str) -> Pair:
        """Give a vehicle back to the station that handed it over; raises as `hand_over`."""
        with self._lock:
            before = self._pair(vehicle).before
            if before is None:
                raise SettingError(vehicle, "wasn't handed over", "Hand it over to a station by name")
            return self.hand_over(vehicle, before, by)

    def release(self, vehicle: str, by: str) -> None:
        """End a vehicle's pair: it stands.

        Raises:
            SettingError: it is in none. SpaceError: that can't be kept.
        """
        with self._lock:
            pair = self._pair(vehicle)
            self._note("release", pair, by)
            self._keep(self._last, {k: v for k, v in self._pairs.items() if k != vehicle})
            for role, name in ((Role.VEHICLE, vehicle), (Role.STATION, pair.station)):
                self._order(role, name, Release(why=f"{by} released {vehicle}"))

    # what is shown

    def facts(self) -> dict[str, Any]:
        """All parties and pairs, for the page and its API."""
        with self._lock:
            of_station = {pair.station: pair for pair in self._pairs.values()}
            parties = sorted(self._parties.values(), key=lambda one: one.peer.name)
            found: dict[str, list[dict[str, Any]]] = {"vehicles": [], "stations": []}
            for one in parties:
                pairs = self._pairs if one.peer.role == Role.VEHICLE else of_station
                pair = pairs.get(one.peer.name)
                found["vehicles" if one.peer.role == Role.VEHICLE else "stations"].append(
                    {
                        "name": one.peer.name, "there": one.send is not None, "since": one.since,
                        "address": one.address, "cameras": one.hello.cameras,
                        "pair": None if pair is None else pair.number,
                        "other": None if pair is None else pair.station if pairs is self._pairs else pair.vehicle,
                        "before": None if pair is None else pair.before,
                        **one.status.model_dump(exclude={"kind", "pair"}),
                    }
                )  # fmt: skip
            return found

    # within

    def _of(self, role: Role, name: str) -> Pair | None:
        if role == Role.VEHICLE:
            return self._pairs.get(name)
        return next((pair for pair in self._pairs.values() if pair.station == name), None)

    def _pair(self, vehicle: str) -> Pair:
        if vehicle not in self._pairs:
            raise SettingError(vehicle, "is driven by nobody", "Join it with a station first")
        return self._pairs[vehicle]

    def _free(self, vehicle: str, station: str) -> None:
        """Both are there, and the station drives nobody."""
        for role, name in ((Role.VEHICLE, vehicle), (Role.STATION, station)):
            party = self._parties.get((role, name))
            if party is None or party.send is None:
                raise SettingError(name, f"is no {role} that is connected now", "Start it, and look at the page")
        if (pair := self._of(Role.STATION, station)) is not None:
            raise BusyError(station, f"drives {pair.vehicle}", "Release that first")

    def _adopt(self, peer: Peer, driving: Driving | None) -> None:
        """A vehicle that says that it is driven, where nothing is known of it, and the same from its station's side."""
        if driving is None:
            return
        role = Role.STATION if peer.role == Role.VEHICLE else Role.VEHICLE
        other = self._parties.get((role, driving.other))
        agreed = None if other is None or other.send is None else other.hello.driving
        if agreed is None or (agreed.pair, agreed.other) != (driving.pair, peer.name):
            return
        vehicle, station = (peer.name, driving.other) if peer.role == Role.VEHICLE else (driving.other, peer.name)
        if driving.pair > self._last and self._of(Role.VEHICLE, vehicle) is None is self._of(Role.STATION, station):
            self._change("found driving", Pair(driving.pair, vehicle, station, self._now(), GATEWAY))

    def _change(self, what: str, pair: Pair) -> Pair:
        """Keep a pair, then tell both."""
        self._note(what, pair, pair.by)
        self._keep(pair.number, {**self._pairs, pair.vehicle: pair})
        self._tell(pair)
        return pair

    def _tell(self, pair: Pair) -> None:
        """Tell both of a pair, as far as they are there."""
        vehicle = self._parties.get((Role.VEHICLE, pair.vehicle))
        station = self._parties.get((Role.STATION, pair.station))
        for to, other in ((vehicle, station), (station, vehicle)):
            if to is not None and to.send is not None and other is not None:
                member = Member(name=other.peer.name, fingerprint=other.peer.fingerprint)
                to.send(Join(pair=pair.number, other=member, listening=other.hello.listening))

    def _order(self, role: Role, name: str, order: Order) -> None:
        party = self._parties.get((role, name))
        if party is not None and party.send is not None:
            party.send(order)

    def _note(self, what: str, pair: Pair, by: str) -> None:
        told = {"what": what, "vehicle": pair.vehicle, "station": pair.station, "pair": pair.number, "by": by}
        self.audit.add({"time": round(self._now(), 3), **told})

    def _read(self) -> tuple[int, dict[str, Pair]]:
        try:
            last, pairs = _KEPT.validate_json(self._file.read_bytes())
        except FileNotFoundError:
            return 0, {}
        except (OSError, ValidationError) as error:
            remedy = "Delete it: pairs that drive are found again, as both of them tell"
            raise InputError(self._file, f"can't be read ({error!s:.100})", remedy) from None
        return last, {pair.vehicle: pair for pair in pairs}

    def _keep(self, last: int, pairs: dict[str, Pair]) -> None:
        fresh = self._file.with_suffix(".new")
        try:
            with fresh.open("wb") as file:
                file.write(_KEPT.dump_json((last, tuple(pairs.values())), indent=1))
                file.flush()
                os.fsync(file.fileno())
            fresh.replace(self._file)
        except OSError as error:
            raise from_os_error(error, self._file) from None
        self._last, self._pairs = last, pairs
