"""Step `reconstruct`: poses and lenses of unposed photos, or of a video's frames, by structure from motion (COLMAP)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core import sandbox
from scan2sim.pipeline.core.errors import DataError, StepError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.parameters import Rate
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.io.file_checks import copy_tree
from scan2sim.pipeline.io.photogrammetry import colmap as model_io
from scan2sim.slam.reconstruction import colmap
from scan2sim.slam.reconstruction import photos as photos_io
from scan2sim.slam.reconstruction.lenses import LensParams, by_camera, contradictions, lenses
from scan2sim.slam.reconstruction.pairs import all_pairs, following_pairs, near_pairs, unique
from scan2sim.slam.reconstruction.photos import Photo
from scan2sim.slam.video import open_video

EXHAUSTIVE_MAX = 40
"""Photos up to which all pairs are matched by default; more are assumed to be in the order in which they were taken."""
EXTRACT_CHUNK, MATCH_CHUNK = 16, 200
"""Photos, and pairs, per child process: progress is reported and kept in between."""
STATIC_MAX = 0.01
"""Displacement of features, relative to the photo's width, up to which a camera is static; in 90 % of the pairs. More
than a mast shakes in the wind, less than distant photos of a camera that moves."""
CALL = "scan2sim.slam.reconstruction.colmap:"


class Reconstructed(LensParams):
    """Lens, matching and limits of a reconstruction: the options of `scan2sim import images`."""

    matching: Literal["auto", "sequential", "exhaustive"] = Field(
        "auto",
        description="Photos to match: with the following ones (sequential: videos, photos in order), or all pairs "
        f"(exhaustive); auto: exhaustive up to {EXHAUSTIVE_MAX} photos, else with the following ones and the nearest "
        "ones by the GPS in their EXIF.",
    )
    fps: Rate = Field(5.0, description="Frames per second to take from a video.")
    until: Annotated[float, Field(ge=0, le=1e7)] = Field(
        0.0, description="Use only this many seconds of a video; 0: all of it."
    )
    features: Annotated[int, Field(ge=100, le=100_000)] = Field(
        8192, description="Greatest number of features per photo."
    )
    time_limit: Annotated[float, Field(ge=0.01, le=1000)] = Field(
        12.0, exclude=True, description="Hours after which COLMAP's mapping ends with an error."
    )


def reconstruct(inputs: Inputs, params: Reconstructed, out: Path, report: Report, checkpoint: Path) -> Done:
    """Reconstruct the photos in `photos`, a folder or a video.

    Optional inputs: `times` (seconds, one per line), `camera` (calibration file).
    Files: `model` (COLMAP's binary format; its unit is arbitrary), `photos` and `summary` (JSON), `frames` of a video.

    Raises:
        InputError: there are no photos. DataError: they can't be reconstructed.
        StepError: COLMAP crashed, or took longer than the limit.
    """
    source, is_video = inputs["photos"], inputs["photos"].is_file()
    warnings: list[str] = []
    if is_video:
        video, images = open_video(source), out / "frames"
        photos = photos_io.extract_frames(
            video, images, params.fps, params.until, part(report, 0, 0.1), warnings.append
        )
    else:
        images = source
        photos, warnings = photos_io.read_photos(source, part(report, 0, 0.1))
        if "times" in inputs:
            photos = photos_io.with_times(photos, photos_io.list_photos(source), inputs["times"])
    given = lenses(source, photos, params, inputs.get("camera"), images)
    warnings += contradictions(photos, given)
    database, staged = checkpoint / "database.db", checkpoint / "images"
    names = photos_io.stage(photos, images, staged)
    cameras = list(zip(by_camera(photos), given, strict=True))
    fixed = _extract(database, staged, cameras, names, params, part(report, 0.1, 0.4))
    exhaustive = params.matching == "exhaustive" or (
        params.matching == "auto" and not is_video and len(photos) <= EXHAUSTIVE_MAX
    )
    chosen = list(all_pairs(photos)) if exhaustive else following_pairs(photos)
    if params.matching == "auto" and not exhaustive:
        chosen = unique([*chosen, *near_pairs(photos)])
    pairs = [(names[one], names[other]) for one, other in chosen]
    for at in range(0, len(pairs), MATCH_CHUNK):
        part(report, 0.4, 0.7)(at / len(pairs), f"matching pair {at + 1} of {len(pairs)}")
        _call("match", database, pairs[at : at + MATCH_CHUNK], hours=params.time_limit)
    _check_motion(source, _call("displacements", database, hours=params.time_limit))
    report(0.7, f"mapping {len(photos)} photos")
    models = checkpoint / "models"
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    found: list[colmap.Component] = _call(
        "reconstruct", database, staged, models, fixed, {new: old for old, new in names.items()},
        hours=params.time_limit,
    )  # fmt: skip
    if not found:
        raise _no_model(source, exhaustive)
    best = found[0]
    copy_tree(best.folder, out / "model")
    left_out = [photo.name for photo in photos if photo.name not in best.names]
    metrics = {
        "summary": f"COLMAP: {len(best.names)} of {len(photos)} photos, {best.points:,} points, {best.error:.2f} px",
        "photos": len(photos), "posed": len(best.names), "points": best.points,
        "reprojection_error_px": round(best.error, 3), "left_out": left_out,
        "models": [{"photos": len(one.names), "first": one.names[0], "last": one.names[-1]} for one in found],
        "lenses": _lenses(out / "model", images),
    }  # fmt: skip
    if left_out:
        warnings.append(_left_out(found, left_out, photos, exhaustive))
    summary = out / "reconstruction.json"
    summary.write_text(json.dumps(metrics, indent=1), encoding="utf-8")
    files = {"model": out / "model", "summary": summary, "photos": photos_io.write(out / "photos.json", photos)}
    return Done(files | ({"frames": images} if is_video else {}), metrics, warnings)


def part(report: Report, start: float, end: float) -> Report:
    """Progress of a part of a step."""

    def within(fraction: float, message: str = "") -> None:
        report(start + (end - start) * fraction, message)

    return within


def _extract(
    database: Path,
    images: Path,
    cameras: Sequence[tuple[Sequence[Photo], colmap.Lens]],
    names: Mapping[str, str],
    params: Reconstructed,
    report: Report,
) -> list[int]:
    """Extract the features of all photos, files `names` in `images`; returns the ids of cameras with fixed lenses."""
    fixed, done, total = [], 0, sum(len(group) for group, _ in cameras)
    for group, lens in cameras:
        files = [names[photo.name] for photo in group]
        camera: int = _call("add_photos", database, images, files, lens, hours=params.time_limit)
        if lens.fixed:
            fixed.append(camera)
        for at in range(0, len(group), EXTRACT_CHUNK):
            report(done / total, f"features of {group[at].name} ({done} of {total})")
            _call("extract", database, images, files[at : at + EXTRACT_CHUNK], params.features, hours=params.time_limit)
            done += len(files[at : at + EXTRACT_CHUNK])
    return fixed


def _call(function: str, *arguments: Any, hours: float) -> Any:
    """Run a function of `slam.reconstruction.colmap` in a child process."""
    try:
        return sandbox.call(f"{CALL}{function}", *arguments, timeout=hours * 3600)
    except StepError as error:
        raise StepError(
            f"COLMAP ({function})", error.cause,
            "Run again to resume, also with a longer --time-limit; or give fewer photos (every second one), or less "
            "--features",
        ) from None  # fmt: skip


def _check_motion(source: Path, moved: np.ndarray) -> None:
    """Raise a DataError if the photos don't overlap, or the camera is static."""
    if not len(moved):
        raise DataError(
            source, "no two of its photos show the same surfaces",
            "Take photos that overlap by two thirds; textureless or blurred ones can't be matched",
        )  # fmt: skip
    if np.quantile(moved, 0.9) < STATIC_MAX:
        raise DataError(
            source, "the camera doesn't move: features stay at the same pixels in all photos",
            "Give photos or a video of a moving camera",
        )  # fmt: skip


def _no_model(source: Path, exhaustive: bool) -> DataError:
    more = "" if exhaustive else ", --matching exhaustive if they are not in order"
    return DataError(
        source, "its photos can't be reconstructed: too few overlap, or the camera turns without moving",
        f"Take photos from positions a few metres apart that overlap by two thirds; try --focal (pixels){more}",
    )  # fmt: skip


def _left_out(
    found: Sequence[colmap.Component], left_out: Sequence[str], photos: Sequence[Photo], exhaustive: bool
) -> str:
    """Warning about photos without a pose."""
    others = "; ".join(f"{one.names[0]} to {one.names[-1]} ({len(one.names)})" for one in found[1:])
    parts = f", in {len(found) - 1} separate parts among others: {others}" if others else ""
    names = ", ".join(left_out[:10]) + (", ..." if len(left_out) > 10 else "")
    remedy = "" if exhaustive else "; if they are not in order, --matching exhaustive compares all of them"
    return (
        f"{len(left_out)} of {len(photos)} photos don't connect to the others and are left out{parts}: {names}{remedy}"
    )


def _lenses(model: Path, images: Path) -> dict[str, Any]:
    """Model, focal length and distortion of each camera."""
    from scan2sim.pipeline.io.photogrammetry import Photos

    cameras = model_io.read(model, Photos(images)).cameras
    return {
        name: {
            "model": one.model,
            "focal": round(one.fx, 2),
            "k1": round(one.distortion[0], 5) if one.distortion else 0.0,
        }
        for name, one in cameras.items()
    }


def can_reconstruct(params: Reconstructed) -> None:
    """Raise an UnavailableError where pycolmap isn't installed."""
    require("import images", "pycolmap")


RECONSTRUCT = Step(
    "reconstruct", 3, reconstruct, Reconstructed, check=can_reconstruct, resumes=True, memory=(1.5, 0)
)  # fmt: skip
