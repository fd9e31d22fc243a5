"""Import sweeps: a moving scanner's sweeps and a trajectory become a corridor."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pydantic import Field

from scan2sim.pipeline.core.parameters import Focal, Pixels
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.importers import sweeps as io


class SweepsParams(io.Placing):
    """How sweeps are placed, and photos taken along."""

    camera: str = Field("auto", description="auto, pinhole, equirectangular, or a TOML like a tile's.")
    focal: Focal | None = Field(None, description="Pixels, of a pinhole camera.")
    centre: tuple[Pixels, Pixels] | None = Field(None, description="Pixels; default: the middle.")


def import_sweeps(inputs: Inputs, params: SweepsParams, out: Path, report: Report) -> Done:
    """A tile of `sweeps` (a folder) placed by `poses`; see `tile_of` for what else may be given.

    Raises:
        ScanError: as `pipeline.importers.sweeps.import_sweeps`.
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
        warn, report, link, overwrite, name: as of `pipeline.importers.sweeps.import_sweeps`.

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
        pictures = io.Pictures(photos, camera, inputs.get("photo_times"), inputs.get("mask"), beside)
    return io.import_sweeps(
        inputs["sweeps"], inputs["poses"], out, params, photos=pictures, times=inputs.get("times"),
        extrinsics=None if extrinsics is None else io.read_extrinsics(extrinsics), link=link, overwrite=overwrite,
        name=name, warn=warn, report=report,
    )  # fmt: skip


IMPORT_SWEEPS = Step("import_sweeps", io.VERSION, import_sweeps, SweepsParams)
