"""Photos to reconstruct: a folder of images, with sizes, focal lengths and times by EXIF, or frames of a video."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.camera import panorama
from scan2sim.pipeline.core.errors import DataError, InputError, UnavailableError
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.images import exif, image
from scan2sim.pipeline.io.images.decoders import heif
from scan2sim.slam.video import Video, decode, upright

COLMAP_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
"""Suffixes of photos that COLMAP reads; others are converted for it."""
MIN_PHOTOS = 3
"""Photos that a reconstruction needs: two have no scale in common with a third."""
FILM_DIAGONAL_MM = math.hypot(36, 24)
"""Diagonal of the film that "35 mm equivalent" refers to (CIPA DCG-001)."""
UNREAD_SUFFIXES = (
    ".avif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".gpr", ".insp"
)  # fmt: skip
"""Raw photos, those of 360-degree cameras and rare formats, which aren't read."""
JPEG_QUALITY = 95
"""Quality of the JPEG files of video frames, 0 to 100."""


@dataclass(frozen=True)
class Photo:
    """A photo.

    Attributes:
        name: path relative to the folder of the photos, with slashes.
        width, height: pixels.
        focal: focal length by EXIF, pixels; None if unknown.
        time: seconds: UNIX time by EXIF, or since the first frame of a video; None if unknown.
        zoned: whether `time` is in UTC; otherwise its time zone is unknown.
    """

    name: str
    width: int
    height: int
    focal: float | None = None
    time: float | None = None
    zoned: bool = True

    @property
    def camera(self) -> tuple[str, int, int, float | None]:
        """What photos of one camera have in common: folder, size, and focal length by EXIF."""
        return (self.name.rpartition("/")[0], self.width, self.height, self.focal)


def list_photos(folder: Path) -> list[str]:
    """Names of all photos in a folder and its subfolders, in natural order (2 before 10).

    Of an iPhone's photo and its JPEG copy, the copy.

    Raises:
        InputError: the folder is missing.
    """
    if not folder.is_dir():
        raise InputError(folder, "folder not found", "Check the path; give a folder of photos, or a video file")
    found = _files(folder, image.SUFFIXES)
    others = {_stem(name) for name in found if Path(name).suffix.lower() not in heif.SUFFIXES}
    return [name for name in found if Path(name).suffix.lower() not in heif.SUFFIXES or _stem(name) not in others]


def no_photos(folder: Path) -> InputError:
    """The error of a folder without photos; names those in formats that aren't read."""
    cause, remedy = f"contains no photos ({' '.join(image.SUFFIXES)})", "Give a folder of photos, or a video file"
    return InputError(folder, cause, remedy) if (left := _unread(folder, ())) is None else InputError(folder, *left)


def _unread(folder: Path, names: Sequence[str]) -> tuple[str, str] | None:
    """Cause and remedy of photos in other formats without a readable copy beside them; None if there are none."""
    copies = {_stem(name) for name in names}
    left = [name for name in _files(folder, UNREAD_SUFFIXES) if _stem(name) not in copies]
    if not left:
        return None
    kinds = " ".join(sorted({Path(name).suffix.lower() for name in left}))
    cause = f"has {len(left)} photos in formats that aren't read ({kinds}): {', '.join(left[:3])}"
    remedy = "Convert them to JPEG with their EXIF data (`magick mogrify -format jpg`; stitch 360 degree photos first)"
    return cause, remedy


def _files(folder: Path, suffixes: Sequence[str]) -> list[str]:
    found = (path for path in folder.rglob("*") if path.suffix.lower() in suffixes and path.is_file())
    names = (path.relative_to(folder) for path in found)
    used = (name.as_posix() for name in names if not any(part.startswith(".") for part in name.parts))
    return sorted(used, key=file_checks.natural_order)


def _stem(name: str) -> str:
    return name.rpartition(".")[0].lower()


def read_photos(folder: Path, report: Report) -> tuple[list[Photo], list[str]]:
    """Usable photos of a folder, and warnings: damaged ones, and those in other formats, are left out.

    Raises:
        InputError: there are no photos, or none can be read. DataError: fewer than `MIN_PHOTOS`.
    """
    names, photos, warnings = list_photos(folder), list[Photo](), list[str]()
    if not names:
        raise no_photos(folder)
    if (left := _unread(folder, names)) is not None:
        warnings.append(f"{folder.name} {left[0]}; they are left out. {left[1]}")
    for i, name in enumerate(names):
        report(i / len(names), name)
        path = folder / name
        try:
            image.check_decodes(path)
            width, height = image.size_of(path)
        except (InputError, UnavailableError) as error:
            warnings.append(f"{name} is skipped: {error.cause}")
            continue
        equivalent, taken = exif.focal_35mm(path), exif.time_taken(path)
        focal = None if equivalent is None else equivalent / FILM_DIAGONAL_MM * math.hypot(width, height)
        seconds, zoned = taken or (None, True)
        photos.append(Photo(name, width, height, focal, seconds, zoned))
    if not photos:
        raise InputError(folder, f"none of its {len(names)} photos can be read ({warnings[-1]})", "Copy them again")
    check_count(folder, photos)
    return photos, warnings


def check_count(source: Path, photos: Sequence[Any]) -> None:
    """Raise a DataError if there are too few photos to reconstruct, an InputError if others aren't read."""
    if len(photos) < MIN_PHOTOS:
        count = f"only {len(photos)} photo{'s' if len(photos) > 1 else ''}"
        if source.is_dir() and (left := _unread(source, list_photos(source))) is not None:
            raise InputError(source, f"has {count}, and {left[0].removeprefix('has ')}", left[1])
        raise DataError(
            source, f"has {count}, too few to find where they were taken",
            f"Give at least {MIN_PHOTOS} that overlap, from different positions",
        )  # fmt: skip


def with_times(photos: Sequence[Photo], names: Sequence[str], path: Path) -> list[Photo]:
    """Photos with the times of a text file: seconds, one per line.

    Args:
        photos: usable photos.
        names: all photos in the folder, in order, of the lines.
        path: text file.

    Raises:
        InputError: it can't be read, or the numbers of times and photos differ.
    """
    try:
        seconds = np.loadtxt(file_checks.check(path), ndmin=1).astype(np.float64)
    except (OSError, ValueError) as error:
        raise InputError(path, f"is no list of times ({error})", "Write seconds, one per line") from None
    if seconds.shape != (len(names),) or not np.isfinite(seconds).all():
        raise InputError(path, f"has {len(seconds)} times for {len(names)} photos", "Write one time for every photo")
    times = dict(zip(names, seconds.tolist(), strict=True))
    return [replace(photo, time=times[photo.name], zoned=True) for photo in photos]


def extract_frames(
    video: Video, folder: Path, fps: float, until: float, report: Report, warn: Callable[[str], None]
) -> list[Photo]:
    """Write frames of a video file as JPEG files into `folder`.

    Args:
        video: the video.
        folder: folder to create.
        fps: frames per second of the video to extract.
        until: end of the part to extract, seconds; 0: all of it.
        report: receives progress.
        warn: receives a warning if the video is damaged.

    Raises:
        DataError: fewer than `MIN_PHOTOS`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    photos: list[Photo] = []
    length = video.count / video.fps if video.count else 0.0
    for time, frame in decode(video, warn):
        if until and time > until:
            break
        if time < len(photos) / fps - 1e-6:
            continue
        report(min(time / length, 1.0) if length else 0.5, f"frame at {time:.1f} s")
        name = f"{len(photos):06d}.jpg"
        rgb = upright(np.asarray(frame.to_ndarray(format="rgb24"), np.uint8), frame)
        image.write(folder / name, rgb, quality=JPEG_QUALITY)
        size = (rgb.shape[1], rgb.shape[0])
        focal = None if video.focal_35mm is None else video.focal_35mm / FILM_DIAGONAL_MM * math.hypot(*size)
        photos.append(Photo(name, *size, focal, time))
    check_count(video.path, photos)
    return photos


def check_perspective(source: Path, first: Path, photo: Photo) -> None:
    """Raise an InputError if photos show the whole sphere, or two fisheye circles: they have no focal length.

    Args:
        source: what the user gave: a folder or a video.
        first: file of the first photo.
        photo: its metadata.
    """
    if photo.width != 2 * photo.height or photo.focal is not None:
        return
    grey = image.read_levels(first)
    if panorama.fisheye_pair(grey):
        raise InputError(source, "shows two fisheye circles side by side, as 360 cameras record them", panorama.STITCH)
    if panorama.whole_sphere(grey):
        raise InputError(
            source, "shows 360 panoramas; here, lenses of perspective photos are solved",
            "Give the video, or the folder as frames, to `scan2sim slam`, which tracks panoramas. If the photos are "
            "perspective ones, give --focal (pixels)",
        )  # fmt: skip


def stage(photos: Sequence[Photo], images: Path, folder: Path) -> dict[str, str]:
    """Link photos into `folder` under numbers as names, as COLMAP's lists can't contain blanks.

    Args:
        photos: the photos.
        images: folder of the photos.
        folder: folder to create or complete; photos in formats that COLMAP doesn't read are converted.

    Returns:
        Name in `folder` by the photo's name.
    """
    folder.mkdir(exist_ok=True)
    staged = {}
    for i, photo in enumerate(photos):
        source = images / photo.name
        readable = source.suffix.lower() in COLMAP_SUFFIXES
        target = folder / f"{i:06d}{source.suffix.lower() if readable else '.png'}"
        target.unlink(missing_ok=True)
        if readable:
            file_checks.symlink_or_copy(source, target)
        else:
            image.write(target, image.read_rgb(source))
        staged[photo.name] = target.name
    return staged


def write(path: Path, photos: Sequence[Photo]) -> Path:
    """Write photos as JSON."""
    path.write_text(json.dumps([asdict(photo) for photo in photos], indent=0), encoding="utf-8")
    return path


def read(path: Path) -> list[Photo]:
    """Read photos written by `write`."""
    return [Photo(**one) for one in json.loads(path.read_text(encoding="utf-8"))]
