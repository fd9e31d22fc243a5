"""Parametric low-poly shapes of road users by category and size, with wheels on the ground.

The frame is that of a track's box: the origin at the middle of its bottom face, x forward, y left, z up; metres. Every
part is the convex hull of a few points and has one colour; all of them lie within the box.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F64, I32, U8
from scan2sim.pipeline.tracking.tracks import Track

Rgb = tuple[int, int, int]
GLASS, TYRE, LAMP, TAIL_LAMP, SKIN, TROUSERS, FRAME = (
    (26, 31, 37), (22, 22, 24), (235, 232, 214), (150, 24, 24), (214, 170, 142), (52, 58, 78), (60, 60, 64),
)  # fmt: skip
DEFAULT_PAINT: Rgb = (128, 132, 138)
"""Of those whose colour no photo shows."""
SHADE = 0.25
"""By which walls of a shape are darker than its roof."""
WHEEL_SIDES = 16
STRIDE = 0.18
"""Half the distance between a pedestrian's feet, of the height."""


@dataclass(frozen=True)
class Proportions:
    """Shape of a category of vehicles with four or more wheels, in fractions of its box.

    Attributes:
        rear_overhang, wheelbase: of the length.
        wheel: diameter of the wheels, of the height; at most 1.1 m.
        belt: height of the windows' lower edge.
        bonnet: height of the bonnet's front.
        profile: (x, z) of the cabin's lower and upper ends: rear bottom, rear top, front top, front bottom; x from the
            rear bumper.
        boot: height of the boot's rear edge.
    """

    rear_overhang: float
    wheelbase: float
    wheel: float
    belt: float
    bonnet: float
    profile: tuple[float, float, float, float]
    boot: float


PROPORTIONS = {
    "car": Proportions(0.19, 0.60, 0.43, 0.62, 0.46, (0.06, 0.16, 0.58, 0.74), 0.60),
    "van": Proportions(0.19, 0.62, 0.33, 0.55, 0.42, (0.4, 0.4, 0.76, 0.92), 0.55),
    "truck": Proportions(0.22, 0.60, 0.32, 0.55, 0.40, (0.5, 0.5, 0.97, 0.999), 0.55),
    "bus": Proportions(0.28, 0.50, 0.32, 0.40, 0.36, (0.001, 0.001, 0.99, 0.999), 0.40),
}
TWO_WHEELER_WHEELBASE, TWO_WHEELER_WHEEL = 0.62, 0.38
"""Wheelbase, and diameter of the wheels, of bicycles and motorcycles, as fractions of their length."""
MAX_WHEEL_M = 1.1
LAMP_DEPTH_M = 0.02
"""By which lamps protrude."""


@dataclass(frozen=True)
class Part:
    """A convex part.

    Attributes:
        name: of its material.
        vertices: (V, 3) metres.
        faces: (F, 3) indices, counter-clockwise from outside.
        colour: sRGB.
    """

    name: str
    vertices: F64
    faces: I32
    colour: Rgb


@dataclass(frozen=True)
class Axles:
    """Axles of a vehicle in the frame of its box: distance forward of the box's middle, and wheels; metres."""

    rear: float
    front: float
    wheel_diameter: float
    track_width: float


def axles(category: str, size: Sequence[float]) -> Axles | None:
    """Axles of a vehicle of a category and size (length, width, height); None: pedestrians have none."""
    length, width, height = size
    if category == "pedestrian":
        return None
    if category in ("cyclist", "motorcycle"):
        half = TWO_WHEELER_WHEELBASE * length / 2
        return Axles(-half, half, min(TWO_WHEELER_WHEEL * length, 0.45 * height), 0.0)
    shape = PROPORTIONS.get(category, PROPORTIONS["car"])
    rear = (shape.rear_overhang - 0.5) * length
    return Axles(rear, rear + shape.wheelbase * length, min(shape.wheel * height, MAX_WHEEL_M), 0.85 * width)


def parts(track: Track) -> list[Part]:
    """The shape of a road user, painted in its colour."""
    paint = track.colour or DEFAULT_PAINT
    if track.category == "pedestrian":
        return list(_person(track.size, paint, 0.0, walking=True))
    if track.category in ("cyclist", "motorcycle"):
        return list(_two_wheeler(track.category, track.size, paint))
    return list(_vehicle(track.category, track.size, paint))


def faces_of(track: Track) -> tuple[F64, U8]:
    """Corners (F, 3, 3) of the faces of a road user's shape, and their colours (F, 3) under a bright sky.

    Faces that look up are brightest, for renderers that don't light them: they show textures as the photos do.
    """
    found = parts(track)
    corners = np.concatenate([part.vertices[part.faces] for part in found])
    colours = np.concatenate([np.tile(part.colour, (len(part.faces), 1)) for part in found])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    up = (normals[:, 2] / np.linalg.norm(normals, axis=1)).clip(-0.5, 1).round(1)
    return corners, np.rint(colours * (1 - SHADE + SHADE * up)[:, None]).astype(np.uint8)


def _hull(name: str, points: npt.ArrayLike, colour: Rgb) -> Part:
    from scipy.spatial import ConvexHull

    xyz = np.asarray(points, np.float64)
    hull = ConvexHull(xyz)
    used, faces = np.unique(hull.simplices, return_inverse=True)
    faces = faces.reshape(-1, 3)
    vertices = xyz[used]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return Part(name, vertices, faces.astype(np.int32), colour)


def _box(name: str, low: Sequence[float], high: Sequence[float], colour: Rgb) -> Part:
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    return _hull(name, corners, colour)


def _prism(name: str, profile: Sequence[tuple[float, float, float]], colour: Rgb) -> Part:
    """Convex body of a side view: (x, z, half the width there)."""
    return _hull(name, [(x, side * half, z) for x, z, half in profile for side in (-1, 1)], colour)


def _wheel(x: float, y: float, radius: float, width: float) -> Part:
    angles = 2 * np.pi * np.arange(WHEEL_SIDES) / WHEEL_SIDES - np.pi / 2  # one corner on the ground
    ring = [(x + radius * np.cos(a), radius + radius * np.sin(a)) for a in angles]
    return _hull("tyre", [(u, y + side * width / 2, w) for u, w in ring for side in (-1, 1)], TYRE)


def _vehicle(category: str, size: Sequence[float], paint: Rgb) -> Iterator[Part]:
    length, width, height = size
    shape, found = PROPORTIONS.get(category, PROPORTIONS["car"]), axles(category, size)
    assert found is not None
    half, radius = width / 2, found.wheel_diameter / 2
    sill, belt = 0.7 * radius, shape.belt * height
    rear, front = LAMP_DEPTH_M - length / 2, length / 2 - LAMP_DEPTH_M
    x = [(fraction - 0.5) * length for fraction in shape.profile]
    yield _prism(
        "paint",
        [
            (rear + 0.02 * length, sill, 0.96 * half), (front - 0.02 * length, sill, 0.92 * half),
            (rear, shape.boot * height, 0.94 * half), (rear, 1.6 * sill, 0.96 * half),
            (front, shape.bonnet * height, 0.84 * half), (front, 1.6 * sill, 0.88 * half),
            (x[0], belt, half), (x[3], belt, half), (x[3], 1.6 * sill, half), (x[0], 1.6 * sill, half),
        ],
        paint,
    )  # fmt: skip
    top = height - 0.03 * height
    roof = 0.78 * half if category == "car" else 0.92 * half
    yield _prism(
        "glass", [(x[0], belt, 0.97 * half), (x[1], top, roof), (x[2], top, roof), (x[3], belt, 0.97 * half)], GLASS
    )
    if category == "car":
        cover = [
            (x[1], top, roof),
            (x[2], top, roof),
            (x[1] + 0.05, height, 0.9 * roof),
            (x[2] - 0.1, height, 0.9 * roof),
        ]
    else:  # a closed body behind the driver's cabin
        behind = rear + (0.62 if category == "van" else 0.97 if category == "bus" else 0.78) * length
        low = belt if category != "bus" else 0.8 * height
        cover = [
            (rear, low, half), (behind, low, half), (rear, height, 0.96 * half),
            (min(behind, x[2]), height, 0.96 * half),
        ]  # fmt: skip
    yield _prism("paint", cover, paint)
    if category == "van":  # the rear window, and the roof above the front seats
        yield _box("glass", (-length / 2, -0.7 * half, belt), (rear + 0.1, 0.7 * half, 0.88 * height), GLASS)
        yield _prism(
            "paint",
            [(rear, top, roof), (x[2], top, roof), (rear, height, 0.96 * half), (x[2], height, 0.9 * roof)],
            paint,
        )
    for side in (-1, 1):
        inner, outer = sorted((side * 0.55 * half, side * 0.82 * half))
        z = shape.bonnet * height
        yield _box("lamp", (front - 0.1, inner, 0.76 * z), (length / 2, outer, 0.93 * z), LAMP)
        z = shape.boot * height
        yield _box("tail_lamp", (-length / 2, inner, 0.76 * z), (rear + 0.1, outer, 0.93 * z), TAIL_LAMP)
        for at in (found.rear, found.front):
            yield _wheel(at, side * (half - 0.1 * width / 2 - 0.02), radius, 0.1 * width)


def _two_wheeler(category: str, size: Sequence[float], paint: Rgb) -> Iterator[Part]:
    length, width, height = size
    found = axles(category, size)
    assert found is not None
    radius = found.wheel_diameter / 2
    thick = 0.05 if category == "cyclist" else 0.14
    for x in (found.rear, found.front):
        yield _wheel(x, 0.0, radius, thick)
    seat, bar = 0.52 * height, 0.6 * height
    saddle, pedals, head = (-0.12 * length, seat), (-0.02 * length, 0.9 * radius), (0.28 * length, bar)
    hubs = [(x, radius) for x in (found.rear, found.front)]
    if category == "cyclist":
        for ends in (
            (hubs[0], saddle),
            (hubs[0], pedals),
            (pedals, saddle),
            (pedals, head),
            (saddle, head),
            (head, hubs[1]),
        ):
            yield _prism(
                "frame", [(u + a, w + b, 0.02) for u, w in ends for a in (-0.02, 0.02) for b in (-0.02, 0.02)], FRAME
            )
    else:
        yield _prism("engine", [(u, w, 0.35 * thick) for u, w in (*hubs, saddle, head)], FRAME)
        yield _prism(
            "paint",
            [(u, w, 0.5 * thick) for u, w in (saddle, head, (0.2 * length, 0.75 * bar), (-0.3 * length, seat))],
            paint,
        )
    yield _box("frame", (0.28 * length, -width / 2, bar - 0.03), (0.33 * length, width / 2, bar + 0.03), FRAME)
    person = (0.5 * length, 0.9 * width, height - seat + 0.02)
    yield from _person(person, paint, seat - 0.02, walking=False)
    for side in (-1, 1):
        y = side * 0.18 * width
        yield _hull(
            "trousers",
            [(-0.1 * length, y, seat), (0.16 * length, y, 0.75 * seat), (0.05 * length, y, radius * 0.7)]
            + [
                (u, y + 0.09 * side, w)
                for u, w in ((-0.1 * length, seat), (0.16 * length, 0.75 * seat), (0.05 * length, radius * 0.7))
            ],
            TROUSERS,
        )
        arm = [(0.0, side * 0.35 * width, 0.8 * height), (0.3 * length, side * 0.45 * width, bar)]
        yield _hull(
            "paint",
            [(u + a, v, w + b) for u, v, w in arm for a, b in ((0, 0), (0.06, 0), (0, 0.08))]
            + [(0.03, 0.0, 0.8 * height)],
            paint,
        )


def _person(size: Sequence[float], paint: Rgb, z: float, *, walking: bool) -> Iterator[Part]:
    """A person, or what of one is above a saddle."""
    length, width, height = size
    hip, shoulder = (0.5, 0.82) if walking else (0.0, 0.64)
    depth = min(0.5 * length, 0.28)
    yield _prism(
        "paint",
        [(-depth / 2, z + hip * height, 0.38 * width), (depth / 2, z + hip * height, 0.38 * width),
         (-depth / 2, z + shoulder * height, width / 2), (depth / 2, z + shoulder * height, width / 2)],
        paint,
    )  # fmt: skip
    radius = min(0.09 * height if walking else 0.17 * height, 0.4 * width)
    middle = z + height - radius
    ring = [np.array([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)])
            for a in np.arange(8) * np.pi / 4 for b in (-0.9, 0.0, 0.9)]  # fmt: skip
    yield _hull(
        "skin", [radius * one + (0, 0, middle) for one in [*ring, np.array([0, 0, 1.0]), np.array([0, 0, -1.0])]], SKIN
    )
    if walking:
        for side in (-1, 1):
            foot = min(STRIDE * height, length / 2 - 0.06) * side
            y = side * 0.2 * width
            yield _hull(
                "trousers",
                [(u, y + v, hip * height) for u in (-0.08, 0.08) for v in (-0.15 * width, 0.15 * width)]
                + [(foot + u, y + v, 0.0) for u in (-0.06, 0.06) for v in (-0.1 * width, 0.1 * width)],
                TROUSERS,
            )
