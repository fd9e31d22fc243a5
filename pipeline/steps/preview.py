"""Preview: a version of the world small enough for the browser, for the 3D view of the report."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.splats import SplatLayer
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, Trajectory
from scan2sim.pipeline.steps.pictures import bird_pose, bounds, driver_pose, whole_pose

if TYPE_CHECKING:
    from scan2sim.pipeline.io.worlds.textured_mesh import Textured

CALLBACK = b"scan2simWorld"  # JavaScript function of the report's viewer that receives the GLB
SPLATS_CALLBACK, SPLATS_SCRIPT = "scan2simSplats", "splats_data.js"  # and the function and script of the splats
JPEG_QUALITY = 85  # of the texture pages


class PreviewParams(Params):
    """Size of the preview.

    Attributes:
        megapixels: maximum size of all texture pages together; larger ones are scaled down.
        triangles: maximum number of triangles; larger worlds get no preview.
        splats: maximum number of splats; if there are more, the preview shows surfaces only.
    """

    megapixels: float = Field(32.0, ge=0.1, le=1000)
    triangles: int = Field(2_000_000, ge=0, le=20_000_000)
    splats: int = Field(1_000_000, ge=0, le=3_000_000)


def preview(inputs: Inputs, params: PreviewParams, out: Path, report: Report) -> Done:
    """Pack the textured groups as a GLB inside a script, `preview/world.js`, and splats in `preview/splats_data.js`.

    A page opened from the file system can load scripts, but no other files. Metrics: `scale` of the texture pages,
    number of `splats`, `bytes`, and the initial camera poses `walk` and `turn` as [position, target], local metres;
    `start` names the one to begin with, as in the report's first image.
    """
    from scan2sim.pipeline.camera import renderer
    from scan2sim.pipeline.io.worlds import glb, textured_mesh
    from scan2sim.pipeline.io.worlds.glb import GlbParams
    from scan2sim.pipeline.io.worlds.scene import group_surface

    read = {group: textured_mesh.read(inputs[group]) for group in SURFACES if group in inputs}
    surfaces: dict[str, Textured] = {group: surface for group, surface in read.items() if surface is not None}
    triangles = sum(map(len, surfaces.values()))
    if not 0 < triangles <= params.triangles:
        return Done({}, {"triangles": triangles})
    scale = min(1.0, (params.megapixels * 1e6 / _texels(surfaces)) ** 0.5)
    folder = out / "preview"
    folder.mkdir()
    packed = out / "world.glb"
    shown = [group_surface(group, surface) for group, surface in surfaces.items()]
    glb.write(packed, shown, GlbParams(jpeg_quality=JPEG_QUALITY, glb_bare=True, reflectance=False), scale=scale)
    report(0.7, "camera poses")
    script = folder / "world.js"
    script.write_bytes(CALLBACK + b'("' + base64.b64encode(packed.read_bytes()) + b'");\n')
    packed.unlink()
    splats = _pack_splats(inputs["splats"], params.splats, folder) if "splats" in inputs else 0
    path = Trajectory.load(inputs["path"]).positions if "path" in inputs else np.zeros((0, 3))
    driven = len(path) > 1
    points = np.concatenate([surface.mesh.vertices for surface in surfaces.values()])
    low, high = bounds([points])
    air = bird_pose(low, high) if driven else whole_pose(points.clip(low, high), renderer.pinhole(1280, 720))
    shapes = renderer.Renderer([renderer.Body(surface.mesh) for surface in surfaces.values()])
    metrics: dict[str, Any] = {
        "triangles": triangles,
        "scale": round(scale, 4),
        "splats": splats,
        "bytes": sum(file.stat().st_size for file in folder.iterdir()),
        "start": "walk" if driven else "turn",
        "walk": _position_and_target(driver_pose(path if driven else None, low, high, shapes), low),
        "turn": _position_and_target(air, low),
    }
    return Done({"preview": folder}, metrics)


def _pack_splats(source: Path, most: int, folder: Path) -> int:
    """Write the script of a layer of splats; returns their number, 0 if there are none or more than `most`."""
    from scan2sim.pipeline.io.worlds.packed_splats import script_arguments

    count = SplatLayer.count(source)
    if not 0 < count <= most:
        return 0
    text = f"{SPLATS_CALLBACK}({script_arguments(SplatLayer.load(source))});\n"
    (folder / SPLATS_SCRIPT).write_text(text, encoding="ascii")
    return count


def _texels(surfaces: dict[str, Textured]) -> int:
    """Number of texels of all pages that are in use."""
    from PIL import Image

    total = 0
    for surface in surfaces.values():
        for page in surface.used_pages:
            with Image.open(surface.pages[page]) as image:
                total += image.width * image.height
    return total


def _position_and_target(pose: F64, low: F64) -> list[list[float]]:
    """Position of a camera and its target: a point on the floor, or 20 m ahead."""
    position, ahead = pose[:3, 3], pose[:3, 2]
    distance = (low[2] - position[2]) / ahead[2] if ahead[2] < -0.1 else 20.0
    return [position.round(3).tolist(), (position + ahead * distance).round(3).tolist()]


PREVIEW = Step("preview", 5, preview, PreviewParams)
