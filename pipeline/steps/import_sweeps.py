"""Import sweeps: builds a corridor tile from a moving scanner's sweeps and a trajectory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pydantic import Field

from scan2sim.pipeline.core.parameters import Focal, Pixels
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.importers import sweeps as io


class SweepsParams(io.PlacementParams):
    """How sweeps are registered, and photos are added."""

    camera: str = Field(
        "auto", description="Camera model of the photos: auto, pinhole, equirectangular, or a TOML file as in a tile."
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
) -> Path:
    """Build the tile in the folder `out`; returns its `tile.toml`.

    Args:
        inputs: `sweeps` and `poses`; optional `extrinsics`, `times`, `photos`, `photo_times`, `mask`, and `camera`, a
            file with the photos' camera.
        params: settings.
        warn, report, link, overwrite, name: see `pipeline.importers.sweeps.import_sweeps`.

    Raises:
        ScanError: as `pipeline.importers.sweeps.import_sweeps`.
    """
    extrinsics, photos = inputs.get("extrinsics"), inputs.get("photos")
    pictures = None
    if photos is not None:
        file = inputs.get("camera")
        camera = io.camera_of_photos(
            photos, model="auto" if file else params.camera, focal=params.focal, centre=params.centre, file=file
        )
        beside = None if extrinsics is None else io.photo_extrinsics(extrinsics, photos)
        pictures = io.PhotoInput(photos, camera, inputs.get("photo_times"), inputs.get("mask"), beside)
    return io.import_sweeps(
        inputs["sweeps"], inputs["poses"], out, params, photos=pictures, times=inputs.get("times"),
        extrinsics=None if extrinsics is None else io.read_extrinsics(extrinsics), link=link, overwrite=overwrite,
        name=name, warn=warn, report=report,
    )  # fmt: skip


IMPORT_SWEEPS = Step("import_sweeps", io.VERSION, import_sweeps, SweepsParams)
