"""Cesium in headless Chromium draws the 3D Tiles of splats: all of them near by, as the camera in Python does.

With splats of several pixels the images agree (41 dB, `tests/pipeline/io/test_splat_tiles.py`). Cesium widens splats by
less than a seventh of a pixel, not by half a one as in training, and leaves out those smaller than a third of a pixel:
on the street of KITTI odometry 04 (400 x 180 pixels in the middle of a photo's view) they agree by 29.3 dB, with gaps
in the ground that show the background. So the check requires `MIN_PSNR_DB`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.splats import XYZ, SplatLayer, Splats
from scan2sim.pipeline.core.types import F64, U8, Camera, Frame
from scan2sim.pipeline.io.geodata import crs
from scan2sim.pipeline.io.world_formats import splats_tiles3d
from scan2sim.texturing.splats.view import SplatRenderer
from tests.fakes import cesium
from tests.fakes.consumers.cesium import FINEST_ERROR_PX, missing, onto_earth
from tests.fakes.splat_tiles import leaves, tileset
from tests.fakes.world_checks import Fault, renderings
from tests.fakes.world_checks.reference import WorldReference
from tests.fakes.world_checks.side_by_side import side_by_side

__all__ = ["FORMAT", "check", "missing"]

FORMAT = "splats_tiles3d"
MIN_PSNR_DB = 20.0
"""Minimum agreement with the camera in Python."""
DEFAULT_ERROR_PX = 16.0
"""Cesium's default screen space error."""


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Render from a photo's pose, all splats and with Cesium's default levels, and compare with the camera in Python.

    Raises:
        Fault: splats are missing in Cesium, or its image differs.
    """
    photo = renderings.photo(reference)
    width, height, focal = photo.camera.width, photo.camera.height, photo.camera.fx
    camera = Camera("pinhole", width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    own = drawn_in_python(export, camera, photo.pose)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as work, viewer(export, Path(work), camera) as v:
        levels = v.drawn(photo.pose)
        shown = v.count()
        whole = v.drawn(photo.pose, whole=True)
    folder = export.parents[1] / "pictures"
    folder.mkdir(exist_ok=True)
    side_by_side(folder, "cesium_splats", [("photo", photo.rgb), ("Python", own), ("Cesium", whole)])
    metrics = {
        "splats_shown": shown,
        "psnr_db": round(psnr(own, whole), 2),
        "psnr_levels_db": round(psnr(own, levels), 2),
    }
    if metrics["psnr_db"] < MIN_PSNR_DB:
        raise Fault("its image differs from that of the camera in Python", metrics)
    return metrics


class SplatViewer:
    """Cesium showing splats to a pinhole camera; poses are those of the world.

    Its principal point is the image centre: Cesium 1.145 draws with a copy of its frustum, which has no offsets.
    """

    def __init__(self, view: cesium.Viewer, frame: Frame, camera: Camera) -> None:
        self._view, self._frame, self._camera = view, frame, camera

    def drawn(self, pose: F64, *, whole: bool = False) -> U8:
        """(H, W, 3) image from a pose (4, 4), with Cesium's default levels, or with the finest ones."""
        pixels = FINEST_ERROR_PX if whole else DEFAULT_ERROR_PX
        self._view.look(*onto_earth(self._frame, pose), focal=self._camera.fx, pixels=pixels)
        return self._view.screenshot()

    def count(self) -> int:
        """Number of splats of the levels that are shown."""
        return int(self._view.page.value("tiles.gaussianSplatPrimitive._numSplats"))


@contextmanager
def viewer(export: Path, work: Path, camera: Camera) -> Iterator[SplatViewer]:
    """Open the export in Cesium, with the image size of a camera; `work` is a working folder."""
    about = tileset(export)["extras"]
    if about["crs"] == crs.LOCAL:
        raise Fault("a world without a CRS has no position on Cesium's globe")
    frame = Frame(about["crs"], tuple(about["world_origin_m"]), about["unit_m"])
    with cesium.viewer(export, work, (camera.width, camera.height), splats_tiles3d.FILE) as view:
        yield SplatViewer(view, frame, camera)


def drawn_in_python(export: Path, camera: Camera, pose: F64) -> U8:
    """(H, W, 3) image of all splats of an export from a pose of the world, before Cesium's background.

    Splats and pose are transformed to the coordinates of the first leaf, whose axes are nearly those of all.
    """
    about = tileset(export)["extras"]
    frame = Frame(about["crs"], tuple(about["world_origin_m"]), about["unit_m"])
    found = list(leaves(export))
    to_local = np.linalg.inv(found[0][1])
    parts = []
    for splats, to_earth in found:
        moved, matrix = splats.parameters.copy(), to_local @ to_earth
        moved[:, XYZ] = splats.xyz @ matrix[:3, :3].T + matrix[:3, 3]
        parts.append(moved)
    at, ahead, up = (np.asarray(vector) for vector in onto_earth(frame, pose))
    axes = np.column_stack([np.cross(ahead, up), -up, ahead])
    local = np.eye(4)
    local[:3, :3] = to_local[:3, :3] @ (axes / np.linalg.norm(axes, axis=0))
    local[:3, 3] = to_local[:3, :3] @ at + to_local[:3, 3]
    sky = np.broadcast_to(np.divide(cesium.SKY, 255).astype(np.float32), (2, 4, 3))
    return SplatRenderer(SplatLayer(Splats(np.concatenate(parts)), sky)).view(camera, local).rgb


def psnr(one: U8, other: U8) -> float:
    """Peak signal-to-noise ratio of two images, dB."""
    error = np.mean((one.astype(np.float64) - other) ** 2)
    return float(-10 * np.log10(error / 255**2 + 1e-12))
