"""Import sweeps: builds a corridor tile from a moving scanner's sweeps and a trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Focal, Pixels
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.importers import sweeps
from scan2sim.pipeline.io import trajectory_check
from scan2sim.pipeline.io.calibration import camera_of_photos, photo_extrinsics, read_extrinsics
from scan2sim.pipeline.io.rig import RIG, masks_of_rig, read_rig
from scan2sim.pipeline.pose_check.check import check_photos


class SweepsParams(sweeps.PlacementParams):
    """How sweeps are registered, and photos are added."""

    camera: str = Field(
        "auto",
        description="Camera model of the photos: auto, pinhole, equirectangular, or a file: TOML as in a tile, or the "
        "calibration of another program (docs/inputs.md).",
    )
    focal: Focal | None = Field(None, description="Focal length of a pinhole camera in pixels.")
    centre: tuple[Pixels, Pixels] | None = Field(
        None, description="Principal point in pixels; default: the image centre."
    )


def import_sweeps(inputs: Inputs, params: SweepsParams, out: Path, report: Report) -> Done:
    """Build a tile from `sweeps` (a folder) and `poses`; see `build_tile` for optional inputs.

    Raises:
        ScanError: as `pipeline.importers.sweeps.import_sweeps`.
    """
    warnings: list[str] = []
    tile = build_tile(inputs, params, out / "corridor", link=True, warn=warnings.append, report=report)
    return Done({"corridor": tile.parent}, warnings=warnings)


def build_tile(
    inputs: Inputs,
    params: SweepsParams,
    out: Path,
    *,
    warn: Callable[[str], None],
    report: Report,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    conventions: bool = True,
) -> Path:
    """Build the tile in the folder `out`; returns its `tile.toml`.

    Args:
        inputs: `sweeps` and `poses`; optional `extrinsics`, `times`, `photos` (a folder of photos, or of a rig of
            cameras), `photo_times`, `mask` (of a rig: see `masks_of_rig`), `camera`, a file with the photos' camera,
            and `trajectory_check`, the folder of a check of the poses.
        params: settings.
        warn, report, link, overwrite, name: see `pipeline.importers.sweeps.import_sweeps`.
        conventions: look for usual mistakes in the photos' poses; without, only for offsets.

    Raises:
        ScanError: as `pipeline.importers.sweeps.import_sweeps`.
    """
    extrinsics, photos = inputs.get("extrinsics"), inputs.get("photos")
    pictures = list[sweeps.PhotoInput]()
    is_rig = photos is not None and (photos / RIG).is_file()
    if photos is not None and is_rig:
        rig = read_rig(photos)
        masks = masks_of_rig(inputs.get("mask"), [one.id for one in rig])
        for one in rig:
            T = one.T_camera_scanner
            T = np.linalg.inv(T).astype(np.float64) if params.invert_extrinsics else T
            own = sweeps.PhotoInput(photos / one.id, one.camera, extrinsics=T, id=one.id, subfolder=True)
            pictures.append(replace(own, mask=masks.get(one.id)))
    elif photos is not None:
        file = inputs.get("camera")
        camera = camera_of_photos(
            photos, model="auto" if file else params.camera, focal=params.focal, centre=params.centre, file=file
        )
        beside = None if extrinsics is None else photo_extrinsics(extrinsics, photos)
        pictures.append(sweeps.PhotoInput(photos, camera, inputs.get("photo_times"), inputs.get("mask"), beside))
    tile = sweeps.import_sweeps(
        inputs["sweeps"], inputs["poses"], out, params, photos=pictures, times=inputs.get("times"),
        extrinsics=None if extrinsics is None else read_extrinsics(extrinsics), checked="trajectory_check" in inputs,
        link=link, overwrite=overwrite,
        name=name, warn=warn, report=report,
    )  # fmt: skip
    if photos is not None:
        report(1.0, "checking the photos against the cloud")
        for warning in check_photos(tile, conventions=conventions):
            warn(warning)
    if "trajectory_check" in inputs:
        trajectory_check.copy(inputs["trajectory_check"], tile.parent)
    return tile


IMPORT_SWEEPS = Step("import_sweeps", sweeps.VERSION, import_sweeps, SweepsParams)
