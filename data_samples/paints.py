"""Materials of surfaces, paints, and class codes."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from scan2sim.pipeline.core.classes import CODE

RGB = tuple[float, float, float]


class Material(IntEnum):
    """Pattern drawn by `materials.surface`; `uv` is in metres along the surface unless noted otherwise."""

    PLAIN = 0
    ASPHALT = 1  # uv: chainage and offset from the axis
    SETTS = 2
    KERB = 3
    SLABS = 4
    GRASS = 5
    BRICK = 6
    PLASTER = 7
    STONE = 8
    WINDOW = 9  # uv from the lower left corner, size: of the opening
    DOOR = 10  # the same
    SHOP = 11  # the same
    ROOF_TILES = 12  # v runs up the slope
    BARK = 13
    FOLIAGE = 14
    WOOD = 15
    CAR_BODY = 16  # uv: along the car, and height
    CAR_GLASS = 17  # the same
    CAR_END = 18  # uv: across the car, and height; size[0]: +1 front, -1 rear
    WHEEL = 19  # uv from the hub
    SIGN = 20  # uv in [0, 1] on the image whose index is the seed
    GRIT = 21  # gravel, litter, rubble, render: grain size and contrast by the seed
    PANELS = 22  # boards, sheets, slats: size and direction by the seed


class Paint(NamedTuple):
    """Material, base colour (linear RGB), LAS class code and seed of a face."""

    material: Material
    colour: RGB
    classification: int
    seed: int = 0


def linear(colour: str) -> RGB:
    """Linear RGB of a web colour such as "#c8b090"."""
    values = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    r, g, b = (v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in values)
    return r, g, b


ROAD = CODE["road"]
SIDEWALK = CODE["sidewalk"]
TERRAIN = CODE["terrain"]
BUSH = CODE["low_vegetation"]
TREE = CODE["high_vegetation"]
BUILDING = CODE["building"]
SIGN = CODE["road_sign"]
POLE = CODE["pole"]
VEHICLE = CODE["vehicle"]
PERSON = CODE["person"]
WALL = CODE["wall_or_fence"]
