"""Preview: the world small enough for a browser, which the report shows to turn and to walk through."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, Trajectory
from scan2sim.pipeline.steps.pictures import bird_pose, bounds, driver_pose, whole_pose

if TYPE_CHECKING:
    from scan2sim.pipeline.io.worlds.textured_mesh import Textured

CALL = b"scan2simWorld"  # the function of flows/pages/walk.js that is given the GLB


class PreviewParams(Params):
    """How much a browser is given.

    Attributes:
        megapixels: of all texture pages together; larger ones are scaled down.
        triangles: worlds of more have no preview.
        jpeg_quality: of the pages.
    """

    megapixels: float = Field(32.0, ge=0.1, le=1000)
    triangles: int = Field(2_000_000, ge=0, le=20_000_000)
    jpeg_quality: int = Field(85, ge=1, le=100)


def preview(inputs: Inputs, params: PreviewParams, out: Path, report: Report) -> Done:
    """Pack the textured groups as a GLB inside a script, `preview/world.js`.

    A page that is opened by a double click may read no other file but scripts. Facts: `scale` of the pages' sides,
    `bytes`, and where eyes are at first, `walk` and `turn`: [eye, target], local metres; `start` is one of both, as in
    the report's first picture.
    """
    from scan2sim.pipeline.camera import renderer
    from scan2sim.pipeline.io.worlds import glb, textured_mesh
    from scan2sim.pipeline.io.worlds.glb import GlbParams
    from scan2sim.pipeline.io.worlds.scene import whole

    read = {group: textured_mesh.read(inputs[group]) for group in SURFACES if group in inputs}
    surfaces: dict[str, Textured] = {group: surface for group, surface in read.items() if surface is not None}
    triangles = sum(map(len, surfaces.values()))
    if not 0 < triangles <= params.triangles:
        return Done({}, {"triangles": triangles})
    scale = min(1.0, (params.megapixels * 1e6 / _texels(surfaces)) ** 0.5)
    folder = out / "preview"
    folder.mkdir()
    packed = out / "world.glb"
    shown = [whole(group, surface) for group, surface in surfaces.items()]
    glb.write(packed, shown, GlbParams(jpeg_quality=params.jpeg_quality, glb_bare=True), scale=scale)
    report(0.7, "eyes")
    script = folder / "world.js"
    script.write_bytes(CALL + b'("' + base64.b64encode(packed.read_bytes()) + b'");\n')
    packed.unlink()
    path = Trajectory.load(inputs["path"]).positions if "path" in inputs else np.zeros((0, 3))
    driven = len(path) > 1
    points = np.concatenate([surface.mesh.vertices for surface in surfaces.values()])
    low, high = bounds([points])
    air = bird_pose(low, high) if driven else whole_pose(points.clip(low, high), renderer.pinhole(1280, 720))
    shapes = renderer.Renderer([renderer.Body(surface.mesh) for surface in surfaces.values()])
    facts: dict[str, Any] = {
        "triangles": triangles,
        "scale": round(scale, 4),
        "bytes": script.stat().st_size,
        "start": "walk" if driven else "turn",
        "walk": _eye(driver_pose(path if driven else None, low, high, shapes), low),
        "turn": _eye(air, low),
    }
    return Done({"preview": folder}, facts)


def _texels(surfaces: dict[str, Textured]) -> int:
    """Of all pages that a face lies on."""
    from PIL import Image

    total = 0
    for surface in surfaces.values():
        for page in surface.used_pages:
            with Image.open(surface.pages[page]) as image:
                total += image.width * image.height
    return total


def _eye(pose: F64, low: F64) -> list[list[float]]:
    """Where a camera is, and what it looks at: the floor, or what is 20 m ahead."""
    eye, ahead = pose[:3, 3], pose[:3, 2]
    reach = (low[2] - eye[2]) / ahead[2] if ahead[2] < -0.1 else 20.0
    return [eye.round(3).tolist(), (eye + ahead * reach).round(3).tolist()]


PREVIEW = Step("preview", 3, preview, PreviewParams, side_product=True)
