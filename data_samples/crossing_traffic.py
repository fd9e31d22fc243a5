"""Simulated traffic at a level crossing: trains by a timetable, cars that wait for them, cyclists and pedestrians.

Cars follow each other by the intelligent driver model (Treiber, Hennecke and Helbing, "Congested traffic states in
empirical observations and microscopic simulations", Physical Review E 62, 2000), and stop completely at low speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scan2sim.data_samples.fleet import random_road_user
from scan2sim.data_samples.junction import HALF_EXTENT_M, LANE_WIDTH_M, RAIL_TOP_M, Junction
from scan2sim.data_samples.stage import Actor, Body, Piece
from scan2sim.data_samples.trains import COUPLING_GAP_M, random_train
from scan2sim.pipeline.core.types import F64, Bools

Rng = np.random.Generator

MOVING_SPEED_MIN = 0.1
"""Speed below which an object counts as standing, m/s."""
TIME_STEP_S = 0.04
"""Time step of the simulation."""
TRAFFIC_RANGE_M = 130.0
"""Distance from the crossing within which cars are simulated, and at which trains appear."""
STOP_LINE_M = 8.0
"""Distance of the stop line from the crossing."""
LIGHT_STOP_M = 46.0
"""Distance of another traffic light from the crossing."""
VEHICLE_CLASSES, CLASS_SHARES = ("car", "van", "truck", "bus"), (0.7, 0.12, 0.1, 0.08)


@dataclass(frozen=True)
class Train:
    """Motion of a train.

    Attributes:
        track: id of the object track.
        y: y coordinate of the rail track.
        way: direction of travel, 1: +x, -1: -x.
        pieces: bodies from head to tail, each with the distance of its centre behind the head.
        length: metres.
        head: (T,) position of the head along the direction of travel, metres from the crossing; NaN: absent.
        speed: (T,) m/s.
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
    """A road user in a lane.

    Attributes:
        track: id of the object track.
        label: class.
        body: mesh.
        way: direction of travel, 1 or -1 along the road.
        s: position of its front along the direction of travel, metres from the crossing.
        speed, wish: current and desired speed, m/s.
        standing: whether it has stopped.
    """

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
        """Length in metres."""
        return float(self.body.high[0] - self.body.low[0])


class Walker(NamedTuple):
    """A pedestrian or cyclist beside the road, or a parked car.

    Attributes:
        track, label, body: see `Car`.
        s: position along the road at time 0, metres from the crossing.
        t: offset to the left of the road's centre, metres.
        speed: along the road, m/s; negative: backwards.
    """

    track: int
    label: str
    body: Body
    s: float
    t: float
    speed: float


@dataclass(frozen=True)
class TrafficDensity:
    """Density of the traffic.

    Attributes:
        cars, trains: mean seconds between cars of a lane, and trains of a track.
        light: whether a traffic light stops cars periodically.
        people, parked: number of people and parked cars beside the road.
        quiet: from and to, seconds in which no car appears.
    """

    cars: float
    trains: float
    light: bool
    people: int
    parked: int
    quiet: tuple[float, float] = (0.0, 0.0)


def random_density(rng: Rng) -> TrafficDensity:
    """Random density, from sparse traffic to a jam, with 8 s without new cars."""
    start = float(rng.uniform(5, 30))
    return TrafficDensity(
        cars=float(np.exp(rng.uniform(np.log(2.5), np.log(14)))), trains=float(rng.uniform(2, 9)),
        light=bool(rng.random() < 0.5), people=int(rng.integers(0, 5)), parked=int(rng.integers(0, 4)),
        quiet=(start, start + 8.0),
    )  # fmt: skip


class Traffic:
    """All moving objects at a crossing for `seconds`; deterministic for the state of `rng`."""

    def __init__(self, junction: Junction, seconds: float, density: TrafficDensity, rng: Rng) -> None:
        self.junction, self._rng, self._density = junction, rng, density
        self.times = np.arange(0, seconds, TIME_STEP_S)
        self._count = 0
        self._pool = {
            kind: [Body(random_road_user(kind, rng)) for _ in range(4 if kind == "car" else 2)]
            for kind in VEHICLE_CLASSES
        }
        self.trains = [train for y in junction.tracks for train in self._timetable(y)]
        self._closed = self._closings()
        self._lanes = {way: self._drive(way) for way in (1, -1)}
        self._beside = [*self._people(), *self._parked()]

    def at(self, index: int) -> list[Actor]:
        """All objects at a time step."""
        return [*self._trains_at(index), *self._cars_at(index), *self._beside_at(index)]

    def _track(self) -> int:
        self._count += 1
        return self._count

    def _timetable(self, y: float) -> list[Train]:
        """Trains of the track at `y`, in order: some pass, some stop; the first may be stopped from the start."""
        rng, trains, free = self._rng, [], float(self._rng.uniform(0, self._density.trains))
        first = True
        while free < self.times[-1]:
            cars = random_train(rng)
            length = sum(size + COUPLING_GAP_M for _, size in cars) - COUPLING_GAP_M
            middles, behind = [], 0.0
            for mesh, size in cars:
                middles.append((Body(mesh), behind + size / 2))
                behind += size + COUPLING_GAP_M
            way, cruise = int(rng.choice([-1, 1])), float(rng.uniform(7, 24))
            kind = rng.choice(["pass", "stop", "start"], p=[0.35, 0.3, 0.35] if first else [0.65, 0.35, 0.0])
            head, speed = _train_motion(self.times, free, cruise, str(kind), length, rng)
            trains.append(Train(self._track(), y, way, tuple(middles), length, head, speed))
            there = np.flatnonzero(~np.isnan(head))
            if not len(there) or there[-1] == len(head) - 1:
                break
            free = float(self.times[there[-1]] + rng.uniform(0.5, 1.5) * self._density.trains)
            first = False
        return trains

    def _closings(self) -> Bools:
        """(T,) whether the crossing is closed for cars."""
        closed = np.zeros(len(self.times), bool)
        for train in self.trains:
            ahead = np.maximum(6.0 * train.speed, 4.0)
            with np.errstate(invalid="ignore"):
                closed |= (train.head + ahead > -12) & (train.head - train.length < 12)
        return closed

    def _drive(self, way: int) -> list[list[tuple[Car, float, float]]]:
        """Cars of a lane by time step, each with its s and speed."""
        rng, density = self._rng, self._density
        cars: list[Car] = []
        steps, due = [], float(rng.uniform(0, density.cars))
        s = TRAFFIC_RANGE_M - 20.0
        while s > -TRAFFIC_RANGE_M and rng.random() < 0.7:  # cars present at the start
            if not -STOP_LINE_M - 2 < s < 30:
                cars.append(self._car(way, s, 9.0))
            s -= float(rng.uniform(14, 14 + 8 * density.cars))
        shift, period = float(rng.uniform(0, 20)), float(rng.uniform(16, 24))
        for i, time in enumerate(self.times):
            if time >= due:
                room = not cars or cars[-1].s - cars[-1].length > -TRAFFIC_RANGE_M + 14
                if room and not density.quiet[0] <= time < density.quiet[1]:
                    cars.append(self._car(way, -TRAFFIC_RANGE_M, 9.0))
                due = time + float(rng.exponential(density.cars)) + 1.0
            stops = [-STOP_LINE_M] if self._closed[i] else []
            if density.light and (time + shift) % period < 0.5 * period:
                stops.append(-LIGHT_STOP_M)
            _advance_lane(cars, stops)
            cars = [c for c in cars if c.s < TRAFFIC_RANGE_M]
            steps.append([(c, c.s, c.speed) for c in cars])
        return steps

    def _car(self, way: int, s: float, speed: float) -> Car:
        label = str(self._rng.choice(VEHICLE_CLASSES, p=CLASS_SHARES))
        body = self._pool[label][self._rng.integers(len(self._pool[label]))]
        return Car(self._track(), label, body, way, s, speed, float(self._rng.uniform(8, 14)))

    def _people(self) -> list[Walker]:
        rng, walkers = self._rng, []
        for _ in range(self._density.people):
            label = "cyclist" if rng.random() < 0.35 else "person"
            side, speed = int(rng.choice([-1, 1])), 4.5 if label == "cyclist" else 1.35
            speed *= float(rng.uniform(0.8, 1.2)) * (0.0 if label == "person" and rng.random() < 0.35 else 1.0)
            s = float(rng.uniform(-40, 40)) if speed == 0 else float(rng.uniform(-60, 20))
            if speed == 0 and abs(s) < 14:
                s = float(np.copysign(14 + abs(s), s))
            body = Body(random_road_user(label, rng))
            t = side * (LANE_WIDTH_M + float(rng.uniform(0.5, 1.6)))
            walkers.append(Walker(self._track(), label, body, s, t, side * speed))
        return walkers

    def _parked(self) -> list[Walker]:
        rng, parked = self._rng, []
        for _ in range(self._density.parked):
            label = str(rng.choice(VEHICLE_CLASSES, p=CLASS_SHARES))
            s, side = float(rng.choice([-1, 1]) * rng.uniform(20, 60)), int(rng.choice([-1, 1]))
            body = Body(random_road_user(label, rng))
            parked.append(Walker(self._track(), label, body, s, side * (LANE_WIDTH_M + 2.0 + 1.4), 0.0))
        return parked

    def _trains_at(self, index: int) -> list[Actor]:
        actors = []
        for train in self.trains:
            head = train.head[index]
            if np.isnan(head):
                continue
            heading = 0.0 if train.way == 1 else np.pi
            pieces = tuple(
                Piece(body, np.array([train.way * (head - behind), train.y, RAIL_TOP_M]), heading)
                for body, behind in train.pieces if abs(head - behind) < HALF_EXTENT_M - 15
            )  # fmt: skip
            actors.append(Actor("train", train.track, pieces, float(train.speed[index])))
        return actors

    def _cars_at(self, index: int) -> list[Actor]:
        actors = []
        for way, steps in self._lanes.items():
            for car, s, speed in steps[index]:
                position = self.junction.on_road(way * (s - float(car.body.high[0])), -way * LANE_WIDTH_M / 2)
                heading = self.junction.road + (0.0 if way == 1 else np.pi)
                actors.append(Actor(car.label, car.track, (Piece(car.body, position, heading),), speed))
        return actors

    def _beside_at(self, index: int) -> list[Actor]:
        actors = []
        for user in self._beside:
            position = self.junction.on_road(user.s + user.speed * float(self.times[index]), user.t)
            heading = self.junction.road + (np.pi if user.speed < 0 else 0.0)
            actors.append(Actor(user.label, user.track, (Piece(user.body, position, heading),), abs(user.speed)))
        return actors


def _train_motion(times: F64, start: float, cruise: float, kind: str, length: float, rng: Rng) -> tuple[F64, F64]:
    """(T,) position of a train's head, and its speed.

    Args:
        times: (T,) seconds.
        start: time when it appears.
        cruise: speed, m/s.
        kind: "pass", "stop" (stops for a while) or "start" (stopped at first).
        length: metres.
        rng: random numbers.
    """
    acceleration = float(rng.uniform(0.6, 1.2))  # m/s2
    head, speed = np.full(len(times), np.nan), np.zeros(len(times))
    begin = -TRAFFIC_RANGE_M
    hold = float(rng.uniform(6, 16))
    aim = float(rng.uniform(-0.2, 0.6) * length)
    if -4 < aim < length + 4 and rng.random() < 0.5:  # half of the stopping trains leave the road clear
        aim = -14.0
    s, v = (aim, 0.0) if kind == "start" else (begin, cruise)
    rest = start + hold if kind == "start" else np.inf
    stopped = kind == "start"
    for i, time in enumerate(times):
        if kind != "start" and time < start:
            continue
        if s - length > TRAFFIC_RANGE_M + 60:
            break
        head[i], speed[i] = s, v
        if stopped and time < rest:
            v = 0.0
        elif kind == "stop" and not stopped:
            left = aim - s
            v = min(cruise, float(np.sqrt(max(2 * acceleration * left, 0.0))))
            if left < 0.02 or v < 0.08:
                v, stopped, rest = 0.0, True, time + hold
        else:
            v = min(cruise, v + acceleration * TIME_STEP_S)
        s += v * TIME_STEP_S
    return head, speed


def _advance_lane(cars: list[Car], stops: list[float]) -> None:
    """Advance a lane's cars, in order from the first, by a time step; they wait before the positions `stops`."""
    ahead = None
    for car in cars:
        gap, closing = 1e3, 0.0
        if ahead is not None:
            gap, closing = ahead.s - ahead.length - car.s, car.speed - ahead.speed
        for stop in stops:
            braking_distance = car.speed**2 / (2 * 6.0)
            if car.s + braking_distance < stop + 0.5 and stop - car.s + 1.0 < gap:
                gap, closing = stop - car.s + 1.0, car.speed
        gap = max(gap, 0.1)
        if car.standing and gap < 4.0:
            car.speed = 0.0
        else:
            desired_gap = 2.0 + max(0.0, car.speed * 1.2 + car.speed * closing / (2 * np.sqrt(1.6 * 2.2)))
            change = 1.6 * (1 - (car.speed / car.wish) ** 4 - (desired_gap / gap) ** 2)
            car.speed = max(0.0, car.speed + float(np.clip(change, -7, 2)) * TIME_STEP_S)
            car.standing = car.speed < 0.3 and change <= 0.15 and gap < 4.5
            if car.standing:
                car.speed = 0.0
        car.s += car.speed * TIME_STEP_S
        ahead = car
