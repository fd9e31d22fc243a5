"""Low-poly trees and bushes where vegetation is listed instead of meshed, in the size and colour of the real ones.

The crowns are models of the project (`plants.npz`, made by `data_samples.make_plants`), trunks are tubes, which bodies
collide with as cylinders. All of a tile are one textured mesh, so every format shows them, labelled as vegetation.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, F64, I32, U8, Frame, Mesh
from scan2sim.pipeline.geometry.primitives import tube
from scan2sim.pipeline.io.images import image

MODELS = Path(__file__).with_name("plants.npz")
TREES, BUSHES = 4, 2
"""Models of each, the trees first."""
TREE = 2.5
"""Metres of height from which on a plant is a tree with a trunk."""
TRUNK, SIDES = 0.025, 8
"""The trunk's radius, as a share of the height, and its sides."""
IN_CROWN, IN_GROUND = 0.6, 0.3
"""Share of the height that the trunk reaches up to, and metres that it begins below the ground."""
BARK = (111, 93, 75)
LEAVES = (96, 118, 62)
"""Where the points have no colour."""
DARK, BRIGHT = 0.6, 1.3
"""How much darker and brighter than its mean colour a crown is within, and on top."""
LEVELS = 16
"""Colours are told apart by so many levels a channel."""
BAND, RAMP = 8, 64
"""Texels that a colour is high on the page, and its ramp from dark to bright is long."""
FROM_POINTS = 128
"""Of the page that tells where colours are from, as the step `texture` codes it."""


def plant(places: F64, height: F64, radius: F64, colour: U8, frame: Frame, out: Path) -> None:
    """Write all plants of a tile as a textured mesh below `out`, as `pipeline.io.worlds.textured_mesh` reads it.

    Faces of trunks have the class of high vegetation, crowns none of their own.

    Args:
        places: (P, 3) local metres, on the ground.
        height, radius: (P,) metres, of the crown's outline.
        colour: (P, 3) of the crown.
        frame: of the mesh.
        out: a folder.
    """
    palette, row = np.unique(_coarse(np.concatenate([[BARK], colour])), axis=0, return_inverse=True)
    image.write(out / "page_0.png", _page(palette))
    image.write(out / "page_0_seen.png", np.full((len(palette) * BAND, RAMP), FROM_POINTS, np.uint8))
    vertices, faces, uv, codes, count = [np.zeros((0, 3))], [], [], [], 0
    for i, place in enumerate(places):
        crown = _crown(place, height[i], radius[i])
        parts = [(*crown, row[1 + i], 0)]
        if height[i] >= TREE:
            parts.append((*_trunk(height[i]), row[0], CODE["high_vegetation"]))
        for own, triangles, light, band, code in parts:
            vertices.append(own + place)
            faces.append(triangles + count)
            uv.append(_uv(light, band, len(palette))[triangles])
            codes.append(np.full(len(triangles), code, np.uint8))
            count += len(own)
    mesh = Mesh(
        frame,
        np.concatenate(vertices).astype(np.float32),
        np.concatenate([np.zeros((0, 3), np.int32), *faces]).astype(np.int32),
        uv=np.concatenate([np.zeros((0, 3, 2), np.float32), *uv]).astype(np.float32),
        page=np.zeros(sum(map(len, faces)), np.int16),
        classification=np.concatenate([np.zeros(0, np.uint8), *codes]),
    )
    mesh.save(out / "mesh.npz")


@lru_cache
def models() -> list[tuple[F32, I32, F32]]:
    """Vertices, faces and openness to the sky of all crowns; 1 high, of radius 1."""
    with np.load(MODELS) as kept:
        return [(kept[f"vertices{k}"], kept[f"faces{k}"], kept[f"light{k}"]) for k in range(TREES + BUSHES)]


def _crown(place: F64, height: float, radius: float) -> tuple[F64, I32, F32]:
    """A crown around its foot; which model, and how it is turned, follows from where it stands."""
    chance = np.random.default_rng(np.abs(np.rint(100 * place)).astype(np.int64))
    k = int(chance.integers(TREES)) if height >= TREE else TREES + int(chance.integers(BUSHES))
    vertices, faces, light = models()[k]
    turn = chance.uniform(0, 2 * np.pi)
    c, s = np.cos(turn), np.sin(turn)
    return vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) * (radius, radius, height), faces, light


def _trunk(height: float) -> tuple[F64, I32, F32]:
    """A trunk around its foot."""
    path = [(0, 0, -IN_GROUND), (0, 0, IN_CROWN * height)]
    vertices, faces = tube(path, np.full(2, TRUNK * height), SIDES)
    return vertices, faces, np.full(len(vertices), 0.5, np.float32)


def _coarse(colour: U8) -> U8:
    """The nearest of few colours."""
    step = 256 // LEVELS
    return (colour // step * step + step // 2).astype(np.uint8)


def _page(palette: U8) -> U8:
    """A band a colour, from dark to bright."""
    ramp = np.linspace(DARK, BRIGHT, RAMP)[None, :, None] * palette[:, None].astype(float)
    return np.repeat(np.rint(ramp).clip(0, 255).astype(np.uint8), BAND, axis=0)


def _uv(light: F32, band: int, bands: int) -> F64:
    """(V, 2) places on the page: how bright a vertex is, in the middle of its colour's band."""
    u = (0.5 + light.clip(0, 1) * (RAMP - 1)) / RAMP
    return np.column_stack([u, np.full(len(light), 1 - (band + 0.5) / bands)])
