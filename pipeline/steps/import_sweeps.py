"""Import sweeps: a moving scanner's sweeps and a trajectory become a corridor."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from scan2sim.pipeline.io import sweeps as io
from scan2sim.pipeline.ranges import Focal, Metres, Pixels, Range, Shift, Voxel
from scan2sim.pipeline.step import Done, Inputs, Params, Report, Step


class SweepsParams(Params):
    """How sweeps are placed, and photos taken along."""

    camera: str = Field("auto", description="auto, pinhole, equirectangular, or a TOML like a tile's.")
    focal: Focal | None = Field(None, description="Pixels, of a pinhole camera.")
    centre: tuple[Pixels, Pixels] | None = Field(None, description="Pixels; default: the middle.")
    scanner_poses: bool = Field(False, description="Poses are the scanner's all the same.")
    time_offset: Shift = Field(0.0, description="Seconds to add to times of sweeps and photos.")
    max_range: Range = Field(50.0, description="Metres; returns from further away are left out.")
    min_range: Metres = Field(1.0, description="Metres; nearer returns, the car's own, are left out.")
    deskew: Literal["none", "kitti"] = Field(
        "none", description="kitti: points by the pose of their own moment; or none."
    )
    period: Annotated[float, Field(ge=0.0001, le=1000)] | None = Field(
        None, description="Seconds of the scanner's turn; default: between sweeps."
    )
    voxel: Voxel | None = Field(None, description="Keep one point in so many metres.")
    keep_unsure: bool = Field(False, description="Take unsure stretches of the path, too.")
    crs: str = Field("local", description='CRS of the poses: "EPSG:32633", or "local".')


def import_sweeps(inputs: Inputs, params: SweepsParams, out: Path, report: Report) -> Done:
    """A tile of `sweeps` (a folder) placed by `poses`; see `tile_of` for what else may be given.

    Raises:
        ScanError: as `pipeline.io.sweeps.import_sweeps`.
    """
    warnings: list[str] = []
    tile = tile_of(inputs, params, out / "corridor", link=True, warn=warnings.append, report=report)
    return Done({"corridor": tile.parent}, warnings=warnings)


def tile_of(
    inputs: Inputs,
    params: SweepsParams,
    out: Path,
    *,
    warn: Callable[[str], None],
    report: Report,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
) -> Path:
    """Make the tile in the folder `out`; returns its `tile.toml`.

    Args:
        inputs: `sweeps` and `poses`; `extrinsics`, `times`; `photos`, `photo_times`, `mask`, and `camera`, a file that
            describes theirs.
        params: how.
        warn, report, link, overwrite, name: as of `pipeline.io.sweeps.import_sweeps`.

    Raises:
        ScanError: as `pipeline.io.sweeps.import_sweeps`.
    """
    extrinsics, photos = inputs.get("extrinsics"), inputs.get("photos")
    pictures = None
    if photos is not None:
        file = inputs.get("camera")
        camera = io.camera_of_photos(
            photos, model="auto" if file else params.camera, focal=params.focal, centre=params.centre, file=file
        )
        beside = None if extrinsics is None else io.photo_extrinsics(extrinsics, photos)
        pictures = io.Pictures(photos, camera, inputs.get("photo_times"), inputs.get("mask"), beside)
    return io.import_sweeps(
        inputs["sweeps"], inputs["poses"], out, photos=pictures, times=inputs.get("times"),
        extrinsics=None if extrinsics is None else io.read_extrinsics(extrinsics),
        of="scanner" if params.scanner_poses else None, offset=params.time_offset, max_range=params.max_range,
        min_range=params.min_range, deskew=params.deskew, period=params.period, voxel=params.voxel,
        keep_unsure=params.keep_unsure, crs=params.crs, link=link, overwrite=overwrite, name=name, warn=warn,
        report=report,
    )  # fmt: skip


IMPORT_SWEEPS = Step("import_sweeps", io.VERSION, import_sweeps, SweepsParams)
