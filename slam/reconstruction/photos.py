"""Photos to reconstruct: a folder of images, with sizes, focal lengths and times by EXIF, or frames of a video."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError, UnavailableError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.io import file_checks
from scan2sim.pipeline.io.images import exif, image

COLMAP_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
"""Suffixes of photos that COLMAP reads; others are converted for it."""
MIN_PHOTOS = 3
"""Photos that a reconstruction needs: two have no scale in common with a third."""
FILM_DIAGONAL_MM = math.hypot(36, 24)
"""Diagonal of the film that "35 mm equivalent" refers to (CIPA DCG-001)."""
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

    Raises:
        InputError: the folder is missing.
    """
    if not folder.is_dir():
        raise InputError(folder, "folder not found", "Check the path; give a folder of photos, or a video file")
    found = (path for path in folder.rglob("*") if path.suffix.lower() in image.SUFFIXES and path.is_file())
    names = (path.relative_to(folder) for path in found)
    return sorted(
        (name.as_posix() for name in names if not any(part.startswith(".") for part in name.parts)), key=_natural
    )


def _natural(name: str) -> list[Any]:
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name)]


def read_photos(folder: Path, report: Report) -> tuple[list[Photo], list[str]]:
    """Usable photos of a folder, and a warning for each damaged one, which is skipped.

    Raises:
        InputError: there are no photos, or none can be read. DataError: fewer than `MIN_PHOTOS`.
    """
    names, photos, warnings = list_photos(folder), list[Photo](), list[str]()
    if not names:
        raise InputError(
            folder, f"contains no photos ({' '.join(image.SUFFIXES)})", "Give a folder of photos, or a video"
        )
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
        raise InputError(folder, f"none of its {len(names)} photos can be read ({warnings[0]})", "Copy them again")
    check_count(folder, photos)
    return photos, warnings


def check_count(source: Path, photos: Sequence[Any]) -> None:
    """Raise a DataError if there are too few photos to reconstruct."""
    if len(photos) < MIN_PHOTOS:
        count = f"only {len(photos)} photo{'s' if len(photos) > 1 else ''}"
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
    path: Path,
    folder: Path,
    fps: float,
    until: float,
    focal_35mm: float | None,
    report: Report,
    warn: Callable[[str], None],
) -> list[Photo]:
    """Write frames of a video as JPEG files into `folder`.

    Args:
        path: video file.
        folder: folder to create.
        fps: frames per second of the video to extract.
        until: end of the part to extract, seconds; 0: all of it.
        focal_35mm: 35 mm equivalent focal length by the video's metadata.
        report: receives progress.
        warn: receives a warning if the video is damaged.

    Raises:
        InputError: it has no readable frame. DataError: fewer than `MIN_PHOTOS`. UnavailableError: PyAV is missing.
    """
    require("a video", "av")
    import av

    folder.mkdir(parents=True, exist_ok=True)
    photos: list[Photo] = []
    first: float | None = None
    opened: Any = av.open(str(path.absolute()))
    with opened as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        length = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
        try:
            for frame in container.decode(stream):
                if frame.pts is None:
                    continue
                time = float(frame.pts * frame.time_base)
                first = time if first is None else first
                time -= first
                if until and time > until:
                    break
                if photos and time < (photos[0].time or 0) + len(photos) / fps - 1e-6:
                    continue
                report(min(time / length, 1.0) if length else 0.5, f"frame at {time:.1f} s")
                name = f"{len(photos):06d}.jpg"
                image.write(folder / name, np.asarray(frame.to_ndarray(format="rgb24"), np.uint8), quality=JPEG_QUALITY)
                size = (frame.width, frame.height)
                focal = None if focal_35mm is None else focal_35mm / FILM_DIAGONAL_MM * math.hypot(*size)
                photos.append(Photo(name, *size, focal, time))
        except av.error.FFmpegError as error:
            warn(f"the video can't be read beyond {photos[-1].time if photos else 0:.1f} s ({error})")
    check_count(path, photos)
    return photos


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
