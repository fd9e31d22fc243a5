"""3D Gaussian splats in glTF: `KHR_gaussian_splatting`; readers without it show coloured points.

Compressed as SPZ (`KHR_gaussian_splatting_compression_spz_2`, a draft) they have the attributes that CesiumJS reads:
`COLOR_0` holds colour and opacity, as this draft has it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.splats import Splats
from scan2sim.pipeline.core.types import F32, F64
from scan2sim.pipeline.io import splat_files
from scan2sim.pipeline.io.splat_files import SH_C0
from scan2sim.pipeline.io.worlds.gltf.builder import VERTICES, Builder

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = "KHR_gaussian_splatting_compression_spz_2"
POINTS = 0
PROPERTIES = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
SRGB_OFFSET, SRGB_GAMMA, SRGB_LINEAR_MAX = 0.055, 2.4, 0.04045


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
    turned = splats.y_up()
    xyz = np.ascontiguousarray(turned.xyz)
    rgb = splats.display_rgb
    fallback = np.hstack([_linear(rgb), splats.opacity[:, None]])
    colours = np.clip(np.rint(fallback * 255), 0, 255).astype(np.uint8)
    attributes = {
        "POSITION": builder.accessor(xyz, builder.view(xyz.tobytes(), target=VERTICES), bounds=True),
        "COLOR_0": builder.accessor(colours, builder.view(colours.tobytes(), target=VERTICES), normalized=True),
    }
    values: dict[str, F32] = {
        "ROTATION": turned.quaternion[:, [1, 2, 3, 0]], "SCALE": splats.scale, "OPACITY": splats.opacity,
        "SH_DEGREE_0_COEF_0": ((rgb - 0.5) / SH_C0).astype(np.float32),
    }  # fmt: skip
    for name, column in values.items():
        packed = np.ascontiguousarray(column, np.float32)
        attributes[f"{EXTENSION}:{name}"] = builder.accessor(packed, builder.view(packed.tobytes(), target=VERTICES))
    primitive = {"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: PROPERTIES}}
    mesh = builder.add("meshes", {"name": path.stem, "primitives": [primitive]})
    x, y, z = np.asarray(offset, float).tolist()
    builder.add("nodes", {"name": path.stem, "mesh": mesh, "translation": [x, z, -y]})
    builder.save(path)


def write_spz(path: Path, splats: Splats) -> None:
    """Write splats as a GLB, y up, that holds nothing but them, compressed as SPZ.

    Args:
        path: file to write.
        splats: N splats, local metres, z up.

    Raises:
        SettingError: positions that SPZ can't store.
        SpaceError: it can't be written.
    """
    builder = Builder()
    for extension in (EXTENSION, SPZ_EXTENSION):
        builder.use(extension, required=True)
    turned = splats.y_up()
    payload = builder.view(splat_files.spz(path, turned))
    count = len(splats)
    attributes = {
        "POSITION": builder.accessor(turned.xyz, None, bounds=True),
        "COLOR_0": builder.accessor(np.empty((count, 4), np.uint8), None, normalized=True),
        f"{EXTENSION}:SCALE": builder.accessor(np.empty((count, 3), np.float32), None),
        f"{EXTENSION}:ROTATION": builder.accessor(np.empty((count, 4), np.float32), None),
    }
    properties = PROPERTIES | {"extensions": {SPZ_EXTENSION: {"bufferView": payload}}}
    primitive = {"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: properties}}
    mesh = builder.add("meshes", {"name": path.stem, "primitives": [primitive]})
    builder.add("nodes", {"name": path.stem, "mesh": mesh})
    builder.save(path)


def _linear(rgb: F32) -> F32:
    """Linear light of sRGB colours 0 to 1: glTF's vertex colours are linear, those of splats are not."""
    curve = ((rgb + SRGB_OFFSET) / (1 + SRGB_OFFSET)) ** SRGB_GAMMA
    return np.where(rgb <= SRGB_LINEAR_MAX, rgb / 12.92, curve).astype(np.float32)
