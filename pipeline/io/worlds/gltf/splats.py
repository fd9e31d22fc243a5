"""3D Gaussian splats in glTF: `KHR_gaussian_splatting`; readers without it show coloured points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.splats import Splats
from scan2sim.pipeline.core.types import F32, F64
from scan2sim.pipeline.io.splat_files import SH_C0
from scan2sim.pipeline.io.worlds.gltf.builder import VERTICES, Builder

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0
PROPERTIES = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
TO_Y_UP = np.array([np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0])
"""Quaternion w x y z of the rotation from z up to y up: (x, y, z) becomes (x, z, -y)."""


def write(path: Path, splats: Splats, offset: F64) -> None:
    """Write splats as a GLB, y up, with the world's position in its node.

    Args:
        path: file to write.
        splats: N splats, local metres, z up.
        offset: (3,) metres from the world's origin to that of the splats.

    Raises:
        SpaceError: it can't be written.
    """
    builder = Builder()
    builder.use(EXTENSION)
    xyz = np.column_stack([splats.xyz[:, 0], splats.xyz[:, 2], -splats.xyz[:, 1]]).astype(np.float32)
    alpha = splats.opacity[:, None]
    colours = np.clip(np.rint(np.hstack([splats.rgb, alpha]) * 255), 0, 255).astype(np.uint8)
    rotation = _product(TO_Y_UP, splats.quaternion.astype(np.float64))[:, [1, 2, 3, 0]]
    attributes = {
        "POSITION": builder.accessor(xyz, builder.view(xyz.tobytes(), target=VERTICES), bounds=True),
        "COLOR_0": builder.accessor(colours, builder.view(colours.tobytes(), target=VERTICES), normalized=True),
    }
    values: dict[str, F32] = {
        "ROTATION": rotation.astype(np.float32), "SCALE": splats.scale, "OPACITY": splats.opacity,
        "SH_DEGREE_0_COEF_0": ((splats.rgb - 0.5) / SH_C0).astype(np.float32),
    }  # fmt: skip
    for name, column in values.items():
        packed = np.ascontiguousarray(column, np.float32)
        attributes[f"{EXTENSION}:{name}"] = builder.accessor(packed, builder.view(packed.tobytes(), target=VERTICES))
    primitive = {"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: PROPERTIES}}
    mesh = builder.add("meshes", {"name": path.stem, "primitives": [primitive]})
    x, y, z = np.asarray(offset, float).tolist()
    builder.add("nodes", {"name": path.stem, "mesh": mesh, "translation": [x, z, -y]})
    builder.save(path)


def _product(first: F64, second: F64) -> F64:
    """Products (N, 4) of a quaternion w x y z with quaternions (N, 4)."""
    w, x, y, z = first
    a, b, c, d = second.T
    return np.column_stack(
        [
            w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c, w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ]
    )  # fmt: skip
