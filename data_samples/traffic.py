"""Traffic of a drive: cars, vans and buses along the camera's path, as functions of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from scan2sim.data_samples import objects, paints, signs
from scan2sim.data_samples.ground import LANE_OFFSET_M
from scan2sim.data_samples.layout import Style
from scan2sim.data_samples.paints import RGB, Material, Paint, linear
from scan2sim.data_samples.paths import chainage, extended, heading, smooth
from scan2sim.data_samples.shapes import Part, box, join, part, quads
from scan2sim.data_samples.town import with_sky_openness
from scan2sim.pipeline.core.types import F32, F64, Trajectory

ONCOMING_OFFSET_M = 2 * LANE_OFFSET_M  # to the left of the path
VISIBLE_RANGE_M = 160.0  # distance along the path within which vehicles exist
PATH_EXTENSION_M = 70.0  # that vehicles drive beyond the path's ends; there is road (`ground.EXTENSION_M`)
BUS_TRANSITION_S = 1.5  # in which the buses around the camera come and go


@dataclass(frozen=True)
class Vehicle:
    """A moving vehicle.

    Attributes:
        mesh: x forwards, y to the left.
        half: half its length and width, metres.
        lead: function of time: metres ahead of the camera along the path; NaN: absent.
        offset: metres to the left of the path.
        turned: whether it drives in the opposite direction.
    """

    mesh: Part
    half: tuple[float, float]
    lead: Callable[[float], float]
    offset: float = 0.0
    turned: bool = False


class Traffic:
    """All other vehicles of a drive; deterministic for its seed.

    Args:
        path: (N, 2) driven path.
        trajectory: trajectory of the camera, from the path's start.
        seed: seed of the random numbers.
        bus: (from, to) seconds in which double-deckers drive ahead, behind and on both sides, so that the camera only
            sees them, the road between them, and the sky.
    """

    def __init__(
        self, path: F64, trajectory: Trajectory, seed: int = 0, bus: tuple[float, float] | None = None
    ) -> None:
        self._path = extended(smooth(path), PATH_EXTENSION_M)
        self._s, self._yaw = chainage(self._path), heading(self._path)
        self._times, self._camera = trajectory.times, PATH_EXTENSION_M + chainage(trajectory.positions[:, :2])
        self.vehicles = [*self._flow(np.random.default_rng([seed, 31])), *(_convoy(*bus) if bus else [])]

    def _flow(self, rng: np.random.Generator) -> list[Vehicle]:
        """A vehicle ahead, one behind, oncoming and overtaking vehicles."""
        first, end = float(self._times[0]), float(self._times[-1])
        vehicles = []
        for gap in (rng.uniform(22, 34), -rng.uniform(14, 22)):
            vehicles.append(_vehicle(rng, partial(_following_lead, gap, rng.uniform(3, 8), rng.uniform(0, 6))))
        overtaking = np.arange(first + rng.uniform(6, 14), end, rng.uniform(28, 36))
        vehicles += [
            _vehicle(rng, partial(_overtaking_lead, moment), ONCOMING_OFFSET_M) for moment in overtaking.tolist()
        ]
        moment = first + rng.uniform(1, 4)
        while moment < end + 10:
            if np.abs(overtaking - moment).min(initial=99) > 9:
                vehicles.append(
                    _vehicle(rng, partial(self._oncoming, moment, rng.uniform(8, 13)), ONCOMING_OFFSET_M, True)
                )
            moment += rng.uniform(3, 9)
        return vehicles

    def _oncoming(self, moment: float, speed: float, time: float) -> float:
        """Lead of an oncoming vehicle that meets the camera at `moment`."""
        return float(self._where(moment) - speed * (time - moment) - self._where(time))

    def _where(self, time: float) -> float:
        """The camera's chainage; constant before the drive's start and after its end."""
        return float(np.interp(time, self._times, self._camera))

    def at(self, time: float) -> list[tuple[Vehicle, F64, float]]:
        """Vehicles near the camera, each with its position (2,) and heading."""
        camera = self._where(time)
        found = []
        for v in self.vehicles:
            lead = v.lead(time)
            s = camera + lead
            if not abs(lead) < VISIBLE_RANGE_M or not self._s[0] + 3 < s < self._s[-1] - 3:
                continue
            yaw = float(np.interp(s, self._s, self._yaw))
            xy = np.array([np.interp(s, self._s, self._path[:, k]) for k in range(2)])
            xy = xy + v.offset * np.array([-np.sin(yaw), np.cos(yaw)])
            found.append((v, xy, yaw + (np.pi if v.turned else 0.0)))
        return found

    def near(self, time: float, centre: F64) -> tuple[Part | None, F32]:
        """Mesh of the vehicles near the camera relative to `centre` (2,), None if there are none, and their boxes.

        Boxes are (K, 6): x, y, cosine and sine of the heading, half length, half width.
        """
        here = self.at(time)
        parts = [v.mesh.moved(yaw, (*(xy - centre), 0.01)) for v, xy, yaw in here]
        boxes = [(*(xy - centre), np.cos(yaw), np.sin(yaw), *v.half) for v, xy, yaw in here]
        return (join(parts) if parts else None), np.array(boxes, np.float32).reshape(-1, 6)


def _following_lead(gap: float, change: float, phase: float, time: float) -> float:
    """Lead of a vehicle that keeps a slowly varying distance."""
    return gap + change * float(np.sin(time / 7.0 + phase))


def _overtaking_lead(moment: float, time: float) -> float:
    """Lead of a vehicle that overtakes at `moment`."""
    return 4.5 * (time - moment)


def _convoy_lead(begin: float, end: float, position: float, phase: float, time: float) -> float:
    """Lead of a bus that stays at `position` relative to the camera from `begin` to `end`; NaN well outside."""
    outside = max(begin - time, time - end, 0.0) / BUS_TRANSITION_S
    if outside > 1:
        return float("nan")
    return position + (60.0 if position > 0 else -60.0) * outside**2 + 0.35 * float(np.sin(1.1 * time + phase))


def _vehicle(
    rng: np.random.Generator, lead: Callable[[float], float], offset: float = 0.0, turned: bool = False
) -> Vehicle:
    """Random car, van or bus."""
    colour, kind = Style().car[rng.integers(len(Style().car))], rng.random()
    if kind < 0.68:
        return Vehicle(with_sky_openness(objects.car(colour)), (2.2, 0.9), lead, offset, turned)
    length, width, height = (5.6, 2.1, 2.4) if kind < 0.85 else (11.0, 2.4, 3.1)
    return Vehicle(
        with_sky_openness(coach(length, width, height, colour, rng)), (length / 2, width / 2), lead, offset, turned
    )


def _convoy(begin: float, end: float) -> list[Vehicle]:
    """Four double-deckers around the camera."""
    rng, vehicles = np.random.default_rng(5), []
    for ahead, offset, length, colour in (
        (7.6, 0.0, 11.0, "#b3202a"), (-7.6, 0.0, 11.0, "#2e5a8c"), (0.4, 2.75, 14.0, "#d9b43a"),
        (-0.3, -2.75, 14.0, "#3f7d4e"),
    ):  # fmt: skip
        mesh = with_sky_openness(coach(length, 2.5, 4.3, linear(colour), rng))
        vehicles.append(Vehicle(mesh, (length / 2, 1.25), partial(_convoy_lead, begin, end, ahead, offset), offset))
    return vehicles


def coach(length: float, width: float, height: float, colour: RGB, rng: np.random.Generator) -> Part:
    """A van, bus or double-decker: a box body on wheels with rows of windows and advertisements."""
    body = Paint(Material.PLAIN, colour, paints.VEHICLE, int(rng.integers(1 << 20)))
    x, y = length / 2, width / 2
    parts = [box((-x, -y, 0.35), (x, y, height), body, bottom=True)]
    rows = [1.3] if height < 3.5 else [1.15, 2.85]
    for z in rows:
        for side in (-1, 1):
            for i in range(panes := max(2, int(length / 1.5))):
                if height < 3 and i < panes // 2:
                    continue  # vans have no rear windows
                x0, x1 = -x + 0.2 + i * (length - 0.4) / panes, -x + 0.1 + (i + 1) * (length - 0.4) / panes
                parts.append(panel(x0, x1, side * (y + 0.01), z, z + 0.85, side, glass(rng)))
        for end in (-1, 1):
            parts.append(end_panel(end * (x + 0.01), y - 0.15, z, z + 0.9, end, glass(rng)))
    for side in (-1, 1):
        low = 0.5 if height < 3.5 else 2.1
        for i in range(max(1, int(length / 4.0))):
            image = Paint(Material.SIGN, (1, 1, 1), paints.VEHICLE, int(rng.integers(len(signs.NAMES))))
            x0 = -x + 0.4 + i * (length - 0.8) / max(1, int(length / 4.0))
            parts.append(panel(x0, x0 + 2.1, side * (y + 0.012), low, low + 0.65, side, image, unit=True))
    tyre = Paint(Material.WHEEL, (0.02, 0.02, 0.02), paints.VEHICLE)
    angle = np.linspace(0, 2 * np.pi, 21)[:-1]
    disc = 0.45 * np.column_stack([np.cos(angle), np.sin(angle)])
    for cx in (-0.62 * x, 0.66 * x):
        for side in (-1, 1):
            rim = np.column_stack([cx + disc[:, 0], np.full(20, side * (y + 0.02)), 0.45 + disc[:, 1]])
            fan = np.column_stack([np.zeros(18), np.arange(1, 19), np.arange(2, 20)]).astype(int)
            parts.append(part(rim, fan[:, ::-side], 0.7 * disc, tyre))
    return join(parts)


def glass(rng: np.random.Generator) -> Paint:
    """Paint of a window with a random seed."""
    return Paint(Material.WINDOW, (0.03, 0.03, 0.03), paints.VEHICLE, int(rng.integers(1 << 20)))


def panel(x0: float, x1: float, y: float, z0: float, z1: float, side: int, paint: Paint, *, unit: bool = False) -> Part:
    """A rectangle on the left (`side` 1) or right (-1) side, from x0 to x1; `unit`: uv in [0, 1], else in metres."""
    a, b = (x0, x1) if side < 0 else (x1, x0)
    w, h = (1.0, 1.0) if unit else (x1 - x0, z1 - z0)
    corners = [[(a, y, z0), (b, y, z0), (b, y, z1), (a, y, z1)]]
    return quads(corners, [[(0, 0), (w, 0), (w, h), (0, h)]], paint, size=(w, h))


def end_panel(x: float, half: float, z0: float, z1: float, end: int, paint: Paint) -> Part:
    """A rectangle on the front (`end` 1) or the back (-1)."""
    a, b = -half * end, half * end
    corners = [[(x, a, z0), (x, b, z0), (x, b, z1), (x, a, z1)]]
    w, h = 2 * half, z1 - z0
    return quads(corners, [[(0, 0), (w, 0), (w, h), (0, h)]], paint, size=(w, h))
