"""Who passes a level crossing: trains to a timetable, cars that follow each other and wait for them, people.

Cars follow each other as Treiber, Hennecke and Helbing have it ("Congested traffic states in empirical observations and
microscopic simulations", Physical Review E 62, 2000), and stand once they are slow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scan2sim.data_samples.fleet import any_user
from scan2sim.data_samples.junction import FAR, LANE, RAIL, Junction
from scan2sim.data_samples.stage import Actor, Body, Piece
from scan2sim.data_samples.trains import GAP, any_train
from scan2sim.pipeline.core.types import F64, Bools

Rng = np.random.Generator

STANDS = 0.1
"""m/s below which something stands."""
STEP = 0.04
"""Seconds of a step."""
SIGHT = 130.0
"""Metres from the crossing within which cars drive, and beyond which trains begin and end."""
LINE = 8.0
"""Metres before the crossing where cars wait."""
QUEUE = 46.0
"""Metres before the crossing where a light stops them for other reasons."""
KINDS, SHARES = ("car", "van", "truck", "bus"), (0.7, 0.12, 0.1, 0.08)


@dataclass(frozen=True)
class Train:
    """A train's run: of its head along its own way, by step.

    Attributes:
        way: 1 towards +x, -1 towards -x.
        pieces: bodies from head to tail, each with the distance of its middle behind the head.
        head, speed: (T,) metres along its way from the crossing, NaN where it isn't there, and m/s.
    """

    track: int
    y: float
    way: int
    pieces: tuple[tuple[Body, float], ...]
    length: float
    head: F64
    speed: F64


@dataclass
class Car:
    """A road user in a lane: s of its front, along its own way."""

    track: int
    label: str
    body: Body
    way: int
    s: float
    speed: float
    wish: float
    standing: bool = False

    @property
    def length(self) -> float:
        """Metres."""
        return float(self.body.high[0] - self.body.low[0])


class Walker(NamedTuple):
    """Someone beside the road, or a parked car: place along it at time 0, offset, speed along the road."""

    track: int
    label: str
    body: Body
    s: float
    t: float
    speed: float


@dataclass(frozen=True)
class Busy:
    """How much goes on.

    Attributes:
        cars, trains: seconds between those of a lane or track, about.
        light: whether a light makes cars stop and go.
        people, parked: how many are beside the road.
        quiet: from and to, seconds in which no car comes.
    """

    cars: float
    trains: float
    light: bool
    people: int
    parked: int
    quiet: tuple[float, float] = (0.0, 0.0)


def any_busy(rng: Rng) -> Busy:
    """From a lonely track to a jam; nothing comes for a while."""
    start = float(rng.uniform(5, 30))
    return Busy(
        cars=float(np.exp(rng.uniform(np.log(2.5), np.log(14)))), trains=float(rng.uniform(2, 9)),
        light=bool(rng.random() < 0.5), people=int(rng.integers(0, 5)), parked=int(rng.integers(0, 4)),
        quiet=(start, start + 8.0),
    )  # fmt: skip


class Traffic:
    """All that moves at a crossing for `seconds`; the same for a generator's state."""

    def __init__(self, junction: Junction, seconds: float, busy: Busy, rng: Rng) -> None:
        self.junction, self._rng, self._busy = junction, rng, busy
        self.times = np.arange(0, seconds, STEP)
        self._count = 0
        self._pool = {kind: [Body(any_user(kind, rng)) for _ in range(4 if kind == "car" else 2)] for kind in KINDS}
        self.trains = [train for y in junction.tracks for train in self._timetable(y)]
        self._closed = self._closings()
        self._lanes = {way: self._drive(way) for way in (1, -1)}
        self._beside = [*self._people(), *self._parked()]

    def at(self, index: int) -> list[Actor]:
        """Everyone at a step."""
        return [*self._trains_at(index), *self._cars_at(index), *self._beside_at(index)]

    def _track(self) -> int:
        self._count += 1
        return self._count

    def _timetable(self, y: float) -> list[Train]:
        """Trains of a track, one after the other: some pass, some stop, one may stand there from the start."""
        rng, trains, free = self._rng, [], float(self._rng.uniform(0, self._busy.trains))
        first = True
        while free < self.times[-1]:
            cars = any_train(rng)
            length = sum(size + GAP for _, size in cars) - GAP
            middles, behind = [], 0.0
            for mesh, size in cars:
                middles.append((Body(mesh), behind + size / 2))
                behind += size + GAP
            way, cruise = int(rng.choice([-1, 1])), float(rng.uniform(7, 24))
            kind = rng.choice(["pass", "stop", "start"], p=[0.35, 0.3, 0.35] if first else [0.65, 0.35, 0.0])
            head, speed = _run(self.times, free, cruise, str(kind), length, rng)
            trains.append(Train(self._track(), y, way, tuple(middles), length, head, speed))
            there = np.flatnonzero(~np.isnan(head))
            if not len(there) or there[-1] == len(head) - 1:
                break
            free = float(self.times[there[-1]] + rng.uniform(0.5, 1.5) * self._busy.trains)
            first = False
        return trains

    def _closings(self) -> Bools:
        """(T,) whether cars have to wait."""
        closed = np.zeros(len(self.times), bool)
        for train in self.trains:
            ahead = np.maximum(6.0 * train.speed, 4.0)
            with np.errstate(invalid="ignore"):
                closed |= (train.head + ahead > -12) & (train.head - train.length < 12)
        return closed

    def _drive(self, way: int) -> list[list[tuple[Car, float, float]]]:
        """By step, the cars of a lane with their s and speed."""
        rng, busy = self._rng, self._busy
        cars: list[Car] = []
        steps, due = [], float(rng.uniform(0, busy.cars))
        s = SIGHT - 20.0
        while s > -SIGHT and rng.random() < 0.7:  # those that are there already
            if not -LINE - 2 < s < 30:
                cars.append(self._car(way, s, 9.0))
            s -= float(rng.uniform(14, 14 + 8 * busy.cars))
        shift, period = float(rng.uniform(0, 20)), float(rng.uniform(16, 24))
        for i, time in enumerate(self.times):
            if time >= due:
                room = not cars or cars[-1].s - cars[-1].length > -SIGHT + 14
                if room and not busy.quiet[0] <= time < busy.quiet[1]:
                    cars.append(self._car(way, -SIGHT, 9.0))
                due = time + float(rng.exponential(busy.cars)) + 1.0
            stops = [-LINE] if self._closed[i] else []
            if busy.light and (time + shift) % period < 0.5 * period:
                stops.append(-QUEUE)
            _follow(cars, stops)
            cars = [c for c in cars if c.s < SIGHT]
            steps.append([(c, c.s, c.speed) for c in cars])
        return steps

    def _car(self, way: int, s: float, speed: float) -> Car:
        label = str(self._rng.choice(KINDS, p=SHARES))
        body = self._pool[label][self._rng.integers(len(self._pool[label]))]
        return Car(self._track(), label, body, way, s, speed, float(self._rng.uniform(8, 14)))

    def _people(self) -> list[Walker]:
        rng, walkers = self._rng, []
        for _ in range(self._busy.people):
            label = "cyclist" if rng.random() < 0.35 else "person"
            side, speed = int(rng.choice([-1, 1])), 4.5 if label == "cyclist" else 1.35
            speed *= float(rng.uniform(0.8, 1.2)) * (0.0 if label == "person" and rng.random() < 0.35 else 1.0)
            s = float(rng.uniform(-40, 40)) if speed == 0 else float(rng.uniform(-60, 20))
            if speed == 0 and abs(s) < 14:
                s = float(np.copysign(14 + abs(s), s))
            body = Body(any_user(label, rng))
            t = side * (LANE + float(rng.uniform(0.5, 1.6)))
            walkers.append(Walker(self._track(), label, body, s, t, side * speed))
        return walkers

    def _parked(self) -> list[Walker]:
        rng, parked = self._rng, []
        for _ in range(self._busy.parked):
            label = str(rng.choice(KINDS, p=SHARES))
            s, side = float(rng.choice([-1, 1]) * rng.uniform(20, 60)), int(rng.choice([-1, 1]))
            body = Body(any_user(label, rng))
            parked.append(Walker(self._track(), label, body, s, side * (LANE + 2.0 + 1.4), 0.0))
        return parked

    def _trains_at(self, index: int) -> list[Actor]:
        actors = []
        for train in self.trains:
            head = train.head[index]
            if np.isnan(head):
                continue
            heading = 0.0 if train.way == 1 else np.pi
            pieces = tuple(
                Piece(body, np.array([train.way * (head - behind), train.y, RAIL]), heading)
                for body, behind in train.pieces if abs(head - behind) < FAR - 15
            )  # fmt: skip
            actors.append(Actor("train", train.track, pieces, float(train.speed[index])))
        return actors

    def _cars_at(self, index: int) -> list[Actor]:
        actors = []
        for way, steps in self._lanes.items():
            for car, s, speed in steps[index]:
                place = self.junction.on_road(way * (s - float(car.body.high[0])), -way * LANE / 2)
                heading = self.junction.road + (0.0 if way == 1 else np.pi)
                actors.append(Actor(car.label, car.track, (Piece(car.body, place, heading),), speed))
        return actors

    def _beside_at(self, index: int) -> list[Actor]:
        actors = []
        for one in self._beside:
            place = self.junction.on_road(one.s + one.speed * float(self.times[index]), one.t)
            heading = self.junction.road + (np.pi if one.speed < 0 else 0.0)
            actors.append(Actor(one.label, one.track, (Piece(one.body, place, heading),), abs(one.speed)))
        return actors


def _run(times: F64, start: float, cruise: float, kind: str, length: float, rng: Rng) -> tuple[F64, F64]:
    """(T,) where a train's head is, and its speed: it comes at `start`, and passes, stops a while, or starts."""
    strength = float(rng.uniform(0.6, 1.2))  # m/s2
    head, speed = np.full(len(times), np.nan), np.zeros(len(times))
    begin = -SIGHT
    hold = float(rng.uniform(6, 16))
    aim = float(rng.uniform(-0.2, 0.6) * length)
    if -4 < aim < length + 4 and rng.random() < 0.5:  # half of the trains that stop leave the road free
        aim = -14.0
    s, v = (aim, 0.0) if kind == "start" else (begin, cruise)
    rest = start + hold if kind == "start" else np.inf
    stopped = kind == "start"
    for i, time in enumerate(times):
        if kind != "start" and time < start:
            continue
        if s - length > SIGHT + 60:
            break
        head[i], speed[i] = s, v
        if stopped and time < rest:
            v = 0.0
        elif kind == "stop" and not stopped:
            left = aim - s
            v = min(cruise, float(np.sqrt(max(2 * strength * left, 0.0))))
            if left < 0.02 or v < 0.08:
                v, stopped, rest = 0.0, True, time + hold
        else:
            v = min(cruise, v + strength * STEP)
        s += v * STEP
    return head, speed


def _follow(cars: list[Car], stops: list[float]) -> None:
    """Move a lane's cars, first one first, by a step; they wait before `stops`."""
    ahead = None
    for car in cars:
        gap, closing = 1e3, 0.0
        if ahead is not None:
            gap, closing = ahead.s - ahead.length - car.s, car.speed - ahead.speed
        for stop in stops:
            brakes = car.speed**2 / (2 * 6.0)
            if car.s + brakes < stop + 0.5 and stop - car.s + 1.0 < gap:
                gap, closing = stop - car.s + 1.0, car.speed
        gap = max(gap, 0.1)
        if car.standing and gap < 4.0:
            car.speed = 0.0
        else:
            wanted = 2.0 + max(0.0, car.speed * 1.2 + car.speed * closing / (2 * np.sqrt(1.6 * 2.2)))
            change = 1.6 * (1 - (car.speed / car.wish) ** 4 - (wanted / gap) ** 2)
            car.speed = max(0.0, car.speed + float(np.clip(change, -7, 2)) * STEP)
            car.standing = car.speed < 0.3 and change <= 0.15 and gap < 4.5
            if car.standing:
                car.speed = 0.0
        car.s += car.speed * STEP
        ahead = car
