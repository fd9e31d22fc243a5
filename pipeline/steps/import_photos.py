"""Import photos: makes a tile of a cloud and photos whose poses were estimated."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.plausibility.check import check_tile
from scan2sim.pipeline.pose_check.check import check_photos


class ImportPhotosContext(Context):
    """CRS of the cloud; None: its own."""

    crs: str | None = None


class ImportPhotosParams(Params):
    """How the cloud is read."""

    context: ImportPhotosContext = ImportPhotosContext()


def import_photos(inputs: Inputs, params: ImportPhotosParams, out: Path, report: Report) -> Done:
    """Make a tile of `cloud`, and the photos in `images` posed by `table`. File: `tile`, a folder.

    Raises:
        ScanError: as `build_tile`.
    """
    warnings: list[str] = []
    tile = build_tile(inputs, params, out / "tile", warn=warnings.append, report=report, link=True)
    return Done({"tile": tile.parent}, warnings=warnings)


def build_tile(
    inputs: Inputs,
    params: ImportPhotosParams,
    out: Path,
    *,
    warn: Callable[[str], None],
    report: Report,
    link: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    classes: Mapping[int, int] | None = None,
) -> Path:
    """Build the tile in the folder `out`; returns its `tile.toml`. Arguments are those of `import_las`.

    Raises:
        UnavailableError: there is no cloud. ScanError: as `import_las`.
    """
    if "cloud" not in inputs:
        raise UnavailableError(
            out, "no tile was made: it needs a point cloud, and dense stereo needs GPS, CUDA and pycolmap-cuda12",
            "Give --cloud CLOUD of the place (a survey, merged sweeps, or a robot's map), or run this with CUDA; "
            f"the COLMAP model and trajectory.csv are in {out.with_name(out.name + '-photos')}",
        )  # fmt: skip
    tile = import_las(
        [inputs["cloud"]], out, photos=inputs["table"], images=inputs["images"], crs=params.context.crs, link=link,
        overwrite=overwrite, name=name, classes=classes, warn=warn, report=report,
    )  # fmt: skip
    report(1.0, "checking the photos against the cloud")
    # poses are COLMAP's: no option to change
    for warning in (*check_photos(tile, conventions=False), *check_tile(tile)):
        warn(warning)
    return tile


IMPORT_PHOTOS = Step("import_photos", 1, import_photos, ImportPhotosParams)
