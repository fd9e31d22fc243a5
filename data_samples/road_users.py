"""Road users of the street: a car ahead of the recording vehicle, an oncoming cyclist, and a pedestrian."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scan2sim.data_samples import fleet
from scan2sim.data_samples.layout import Layout
from scan2sim.data_samples.shapes import Part
from scan2sim.pipeline.core.types import F64, Bools
from scan2sim.pipeline.tracking.tracks import Category

END_MARGIN_M = 0.1
"""Distance from the ends of the street within which a road user vanishes."""


@dataclass(frozen=True)
class RoadUser:
    """A road user that moves along the street.

    Attributes:
        category: its class.
        mesh: x forwards, y to the left, the middle of its box at the origin.
        size: length, width, height in metres.
        start: metres from the start of the recording vehicle's pass when it begins.
        speed: m/s in the direction of the pass, negative for the oncoming.
        right: metres to the right of the street's axis.
    """

    category: Category
    mesh: Part
    size: tuple[float, float, float]
    start: float
    speed: float
    right: float

    def pose(self, layout: Layout, since: F64, way: F64) -> tuple[F64, F64, Bools]:
        """Position (N, 3), heading (N,) and presence (N,).

        Args:
            layout: the street.
            since: (N,) seconds since the start of the pass.
            way: (N,) direction of the pass along the axis, 1 or -1.
        """
        driven = self.start + self.speed * since
        s = np.where(way > 0, driven, layout.axis.length - driven)
        t = -way * self.right
        xy, heading = layout.axis.place(s, t)
        z = layout.height(s, t) + 0.01
        margin = self.size[0] / 2 + END_MARGIN_M
        inside = (s > margin) & (s < layout.axis.length - margin)
        return np.concatenate([xy, z[..., None]], axis=-1), heading + np.where(way * self.speed > 0, 0.0, np.pi), inside


def road_users(layout: Layout) -> list[RoadUser]:
    """Road users of a street; the same for the same seed."""
    rng = np.random.default_rng([layout.seed, 8])
    kerb = max(layout.kerb(side) for side in (1, -1))
    return [
        _user("car", fleet.random_road_user("car", rng), 14.0, 9.0, layout.lane / 2),
        _user("cyclist", fleet.random_road_user("cyclist", rng), 0.4 * layout.axis.length, -5.0, 0.45 - layout.lane),
        _user("pedestrian", fleet.random_road_user("person", rng), 0.3 * layout.axis.length, 1.4, kerb + 0.9),
    ]


def _user(category: Category, mesh: Part, start: float, speed: float, right: float) -> RoadUser:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    centred = mesh.vertices - np.array([*(low[:2] + high[:2]) / 2, 0.0])
    length, width, height = (float(value) for value in high - low)
    return RoadUser(
        category, replace(mesh, vertices=centred.astype(np.float32)), (length, width, height), start, speed, right
    )
