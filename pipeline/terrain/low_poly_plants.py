"""Low-poly trees and bushes with the size and colour of the scanned plants, if vegetation is listed instead of meshed.

The crowns are models of the project (`plants.npz`, made by `data_samples.make_plants`); trunks are tubes, whose
collision shapes are cylinders. All plants of a tile are one textured mesh with the class vegetation, which every world
format supports.
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
TREE_MODELS, BUSH_MODELS = 4, 2
"""Number of models of each, trees first."""
MIN_TREE_HEIGHT_M = 2.5
"""Taller plants are trees with a trunk."""
TRUNK_RADIUS_FRACTION, TRUNK_SIDES = 0.025, 8
"""Radius of the trunk relative to the height of the plant, and number of its sides."""
TRUNK_TOP_FRACTION, TRUNK_DEPTH_M = 0.6, 0.3
"""Top of the trunk relative to the height of the plant, and depth of its foot below the ground."""
BARK_RGB = (111, 93, 75)
DEFAULT_LEAF_RGB = (96, 118, 62)
"""Colour of crowns whose points have no colour."""
MIN_BRIGHTNESS, MAX_BRIGHTNESS = 0.6, 1.3
"""Brightness inside and on top of a crown, relative to its mean colour."""
COLOUR_LEVELS = 16
"""Number of levels per channel that colours are quantized to."""
BAND_TEXELS, RAMP_TEXELS = 8, 64
"""Height of a colour's band on the texture page, and length of its ramp from dark to bright."""
SOURCE_POINTS = 128
"""Value of the colour source mask for point colours, as in the step `texture`."""


def plant(positions: F64, height: F64, radius: F64, colour: U8, frame: Frame, out: Path) -> None:
    """Write all plants of a tile as a textured mesh below `out`, readable by `pipeline.io.worlds.textured_mesh`.

    Faces of trunks have the class high vegetation, those of crowns none of their own.

    Args:
        positions: (P, 3) local metres, on the ground.
        height, radius: (P,) height of the plant and radius of its crown, metres.
        colour: (P, 3) colour of the crown.
        frame: frame of the mesh.
        out: folder.
    """
    palette, row = np.unique(_quantize(np.concatenate([[BARK_RGB], colour])), axis=0, return_inverse=True)
    image.write(out / "page_0.png", _page(palette))
    image.write(out / "page_0_seen.png", np.full((len(palette) * BAND_TEXELS, RAMP_TEXELS), SOURCE_POINTS, np.uint8))
    vertices, faces, uv, codes, count = [np.zeros((0, 3))], [], [], [], 0
    for i, position in enumerate(positions):
        crown = _crown(position, height[i], radius[i])
        parts = [(*crown, row[1 + i], 0)]
        if height[i] >= MIN_TREE_HEIGHT_M:
            parts.append((*_trunk(height[i]), row[0], CODE["high_vegetation"]))
        for own, triangles, light, band, code in parts:
            vertices.append(own + position)
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
    """Vertices, faces and sky visibility of all crown models, scaled to height 1 and radius 1."""
    with np.load(MODELS) as kept:
        return [(kept[f"vertices{k}"], kept[f"faces{k}"], kept[f"light{k}"]) for k in range(TREE_MODELS + BUSH_MODELS)]


def _crown(position: F64, height: float, radius: float) -> tuple[F64, I32, F32]:
    """A crown around its foot; its model and rotation are pseudo-random, seeded by the position."""
    random = np.random.default_rng(np.abs(np.rint(100 * position)).astype(np.int64))
    k = (
        int(random.integers(TREE_MODELS))
        if height >= MIN_TREE_HEIGHT_M
        else TREE_MODELS + int(random.integers(BUSH_MODELS))
    )
    vertices, faces, light = models()[k]
    angle = random.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    return vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) * (radius, radius, height), faces, light


def _trunk(height: float) -> tuple[F64, I32, F32]:
    """A trunk around its foot."""
    path = [(0, 0, -TRUNK_DEPTH_M), (0, 0, TRUNK_TOP_FRACTION * height)]
    vertices, faces = tube(path, np.full(2, TRUNK_RADIUS_FRACTION * height), TRUNK_SIDES)
    return vertices, faces, np.full(len(vertices), 0.5, np.float32)


def _quantize(colour: U8) -> U8:
    """Quantize colours to `COLOUR_LEVELS` per channel."""
    step = 256 // COLOUR_LEVELS
    return (colour // step * step + step // 2).astype(np.uint8)


def _page(palette: U8) -> U8:
    """Texture page with a horizontal band per colour, from dark to bright."""
    ramp = np.linspace(MIN_BRIGHTNESS, MAX_BRIGHTNESS, RAMP_TEXELS)[None, :, None] * palette[:, None].astype(float)
    return np.repeat(np.rint(ramp).clip(0, 255).astype(np.uint8), BAND_TEXELS, axis=0)


def _uv(light: F32, band: int, bands: int) -> F64:
    """Texture coordinates (V, 2): brightness of the vertex along the middle of its colour's band."""
    u = (0.5 + light.clip(0, 1) * (RAMP_TEXELS - 1)) / RAMP_TEXELS
    return np.column_stack([u, np.full(len(light), 1 - (band + 0.5) / bands)])
