"""Photos held against their cameras: those of another size, or with an EXIF orientation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from scan2sim.pipeline.core.errors import ScanError
from scan2sim.pipeline.core.types import Camera
from scan2sim.pipeline.io.images import exif
from scan2sim.pipeline.io.images.image import size_of


def fitted_cameras(
    photos: Sequence[Path], names: Sequence[str], cameras: dict[str, Camera], warn: Callable[[str], None]
) -> tuple[list[str], dict[str, Camera]]:
    """Cameras scaled to the size of their photos, where that differs but has the same shape.

    Args:
        photos: (P,) files.
        names: (P,) name of the camera of each.
        cameras: by name.
        warn: receives which cameras were scaled, and which photos an EXIF orientation would turn when displayed.

    Returns:
        Names of the cameras of the photos, and cameras by name.
    """
    found, fitted = dict(cameras), list[str]()
    scaled, turned = Counter[tuple[str, str]](), list[Path]()
    for photo, name in zip(photos, names, strict=True):
        camera = cameras[name]
        size = _size(photo)
        if exif.orientation(photo) != 1:
            turned.append(photo)
        if size is not None and size != (camera.width, camera.height) and (new := scaled_to(camera, size)) is not None:
            key = f"{name}_{size[0]}x{size[1]}"
            found[key] = new
            scaled[name, key] += 1
            name = key
        fitted.append(name)
    for (name, key), count in scaled.items():
        old, new = cameras[name], found[key]
        warn(
            f"{count} photos have {new.width} x {new.height} pixels, but their camera {name} "
            f"{old.width} x {old.height}: the camera is scaled to them ({key})"
        )
    if turned:
        warn(
            f"{len(turned)} photos ({turned[0].name}, ...) have an EXIF orientation. It is ignored: poses and cameras "
            "are taken as those of the pixels as stored. If they are those of the turned photos, turn the files first "
            "(`exiftran -ai`, or `mogrify -auto-orient`)"
        )
    return fitted, found


def scaled_to(camera: Camera, size: tuple[int, int]) -> Camera | None:
    """A camera scaled to photos of a size (width, height); None if their shape differs by more than rounding."""
    width, height = size
    scale = width / camera.width
    if abs(height - scale * camera.height) > max(1.0, scale):
        return None
    if camera.model == "equirectangular":
        return replace(camera, width=width, height=height)
    rows = height / camera.height
    return replace(
        camera, width=width, height=height, fx=camera.fx * scale, fy=camera.fy * rows,
        cx=(camera.cx + 0.5) * scale - 0.5, cy=(camera.cy + 0.5) * rows - 0.5,
    )  # fmt: skip


def _size(photo: Path) -> tuple[int, int] | None:
    """Size of a photo; None if it can't be read, which the steps report."""
    with suppress(ScanError):
        return size_of(photo, parts=True)
    return None
