"""Images with poses inside E57 files (ASTM E2807, `images2D`): written as photos of a tile.

| representation | becomes |
| --- | --- |
| pinhole (a photo, a face of a cube) | a pinhole camera; the image is written unchanged |
| spherical, all around | an equirectangular camera; the image is written unchanged |
| spherical, a part of the sphere | resampled: pinhole up to 100 degrees, else an equirectangular photo with a mask |
| cylindrical | as a part of the sphere |
| visual reference | left out: it has no projection |

Resampled images keep the pixel size of the original at the horizon (in cylindrical ones, up to half of it, which is as
much finer as the image is towards its top and bottom). If the sphere is a whole number of their pixels, as most
programs write it, pixels of spherical images are copied, not interpolated.

Conventions of the standard: poses are image to file coordinates. Pinhole: x right, y up, looking along -z; spherical
and cylindrical: the middle column looks along x, z is up. (0, 0) is the corner of the top left pixel. Masks are 0 where
an image isn't valid, as in tiles.

Source: ASTM E2807-11, 8.4.11 to 8.4.15, equations 20 to 25.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError, printable
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, U8, Bools, Camera
from scan2sim.pipeline.io.clouds import e57
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.tile_folder import without_parents

PINHOLE, SPHERICAL, CYLINDRICAL = "pinholeRepresentation", "sphericalRepresentation", "cylindricalRepresentation"
FIELDS = {
    PINHOLE: ("focalLength", "pixelWidth", "pixelHeight", "principalPointX", "principalPointY"),
    SPHERICAL: ("pixelWidth", "pixelHeight"),
    CYLINDRICAL: ("radius", "pixelWidth", "pixelHeight", "principalPointY"),
}
"""Representations that have a projection, with the numbers that define it."""
BLOBS = ("jpegImage", "pngImage")
PINHOLE_AXES = np.diag([1.0, -1.0, -1.0])
SPHERE_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""The axes of our cameras (x right, y down, z forward, as columns) in those of the image."""
MAX_PINHOLE_ANGLE = math.radians(50)
"""Largest angle between the middle and the border of a part of a sphere or cylinder that becomes a pinhole photo."""
MIN_SPHERE_ANGLE = math.radians(10)
"""A 2:1 image that claims to be narrower is taken for a whole sphere, as some programs write their pixel sizes."""
MAX_SIDE = 32_000
"""Largest side in pixels of a resampled image, a limit of OpenCV's `remap`."""
MAX_GROWTH = 32
"""Largest ratio of pixels of a resampled image to those of the original."""
MIN_PIXEL_ANGLE, MAX_OFFSET = 1e-7, 1e6
"""Limits of the angle (radians) of a pixel, and of focal lengths and principal points (pixels, as in tiles)."""
ROWS = 256  # resampled at a time


class _UnusableError(Exception):
    """Why an image is left out: a predicate, such as "has no pose"."""


@dataclass(frozen=True)
class EmbeddedImage:
    """An image of an E57 file.

    Attributes:
        name: name in the file, or its number there.
        kind: its representation, a key of `FIELDS`.
        numbers: its `FIELDS`.
        size: width and height in pixels, as the file claims.
        pose: (4, 4) camera (x right, y down, z forward) to file coordinates.
        data: content of the JPEG or PNG file.
        mask: content of the mask's PNG file, or None.
        time: GPS time in seconds, or None.
    """

    name: str
    kind: str
    numbers: dict[str, float]
    size: tuple[int, int]
    pose: F64
    data: bytes
    mask: bytes | None
    time: float | None


def extract_all(
    clouds: Iterable[Path], folder: Path, warn: Callable[[str], None], report: Report = silent
) -> tuple[list[dict[str, Any]], dict[str, Camera]]:
    """`extract` of those of a tile's clouds that are E57 files."""
    entries: list[dict[str, Any]] = []
    cameras: dict[str, Camera] = {}
    for path in clouds:
        if path.suffix.lower() in e57.SUFFIXES:
            found, lenses = extract(path, folder, warn, report)
            entries += found
            cameras |= lenses
    return entries, cameras


def extract(
    path: Path,
    folder: Path,
    warn: Callable[[str], None],
    report: Report = silent,
) -> tuple[list[dict[str, Any]], dict[str, Camera]]:
    """Write the images of an E57 file below `photos/` and `masks/` of a tile's folder.

    Images that can't be used are left out with a warning that names them.

    Args:
        path: the E57 file.
        folder: the tile's folder.
        warn: receives what was assumed or left out.
        report: receives progress, 0 to 1, and the image's name.

    Returns:
        entries of `pipeline.io.tile.write_tile`, and their cameras by name.

    Raises:
        InputError: the file can't be opened.
    """
    entries: list[dict[str, Any]] = []
    cameras: dict[Camera, str] = {}
    for share, found in _images(path, warn):
        report(share, f"image {found.name}")
        base = _unused(folder, f"{path.stem}/{found.name}")
        try:
            photo, mask, camera = _write(found, folder, base, _about(path, found.name, warn))
        except (InputError, _UnusableError) as error:
            cause = error.cause if isinstance(error, InputError) else str(error)
            _about(path, found.name, warn)(f"is left out: it {cause}")
            continue
        key = cameras.setdefault(camera, f"{path.name}:{len(cameras) + 1}")
        entries.append(
            {
                "file": photo,
                "camera": key,
                "position": found.pose[:3, 3],
                "rotation": found.pose[:3, :3],
                "time": found.time,
                "mask": mask,
            }
        )
    return entries, {key: camera for camera, key in cameras.items()}


def _about(path: Path, name: str, warn: Callable[[str], None]) -> Callable[[str], None]:
    """`warn` for predicates about an image."""
    return lambda predicate: warn(f"{path}: image {printable(name)} {predicate}")


def _unused(folder: Path, name: str) -> str:
    """A path below `photos/` and `masks/`, without suffix, that no file has yet."""
    clean = "/".join("".join(c if c.isalnum() or c in "-_." else "_" for c in part)[:80] for part in name.split("/", 1))
    clean = without_parents(clean)
    taken = {file.stem for file in (folder / "photos" / clean).parent.glob("*")}
    first, number = clean, 1
    while Path(clean).name in taken:
        number += 1
        clean = f"{first}_{number}"
    return clean


def _images(path: Path, warn: Callable[[str], None]) -> Iterator[tuple[float, EmbeddedImage]]:
    """Images with a projection and a pose, and how far in the file each is."""
    with closing(e57.open_file(path)) as file:
        try:
            root = file.root()
            images = root["images2D"] if root.isDefined("images2D") else []
            nodes = [images[i] for i in range(len(images))]
            scans = root["data3D"] if nodes and root.isDefined("data3D") else []
            poses = {_text(scans[i], "guid"): scans[i] for i in range(len(scans))}
        except Exception as error:  # pye57's own type, or any other that its bindings raise for damaged files
            warn(f"{path}: its images can't be read ({_first_line(error)})")
            return
        for_reference = 0
        for i, node in enumerate(nodes):
            name = str(i)
            try:
                name = Path(_text(node, "name").strip().rpartition("\\")[2]).name.strip("{}") or name
                kind = next((kind for kind in FIELDS if node.isDefined(kind)), None)
                if kind is None:
                    for_reference += 1
                    continue
                found = _read(node, kind, name, path.stat().st_size, poses, _about(path, name, warn))
            except Exception as error:  # as above
                _about(path, name, warn)(f"is left out: it {_first_line(error)}")
                continue
            yield i / len(nodes), found
        if for_reference:
            warn(f"{path}: {for_reference} of {len(nodes)} images have no projection (visual reference): left out")


def _first_line(error: Exception) -> str:
    text = str(error).strip().splitlines()
    line = text[0][:160] if text else type(error).__name__
    return line if isinstance(error, _UnusableError) else f"can't be read ({line})"


def _text(node: Any, key: str) -> str:
    return str(node[key].value()) if node.isDefined(key) else ""


def _read(
    node: Any, kind: str, name: str, file_size: int, scans: dict[str, Any], warn: Callable[[str], None]
) -> EmbeddedImage:
    body = node[kind]
    numbers = {}
    for key in FIELDS[kind]:
        numbers[key] = e57.number_of(body[key]) if body.isDefined(key) else math.nan
        if not math.isfinite(numbers[key]) or (numbers[key] <= 0 and not key.startswith("principal")):
            raise _UnusableError(f"has no valid {key} ({numbers[key]:g})")
        if key.startswith("principal") and abs(numbers[key]) > MAX_OFFSET:
            raise _UnusableError(f"has no valid {key} ({numbers[key]:g})")
    width, height = (int(e57.number_of(body[key])) for key in ("imageWidth", "imageHeight"))
    blob = next((key for key in BLOBS if body.isDefined(key)), None)
    if blob is None:
        raise _UnusableError(f"has no {' or '.join(BLOBS)}")
    time = "acquisitionDateTime/dateTimeValue"
    seconds = e57.number_of(node["acquisitionDateTime"]["dateTimeValue"]) if node.isDefined(time) else math.nan
    axes = np.eye(4)
    axes[:3, :3] = PINHOLE_AXES if kind == PINHOLE else SPHERE_AXES
    return EmbeddedImage(
        Path(name).stem if Path(name).suffix.lower() in image.SUFFIXES else name,
        kind,
        numbers,
        (width, height),
        _pose(node, kind, scans, warn) @ axes,
        _blob(body[blob], file_size),
        _blob(body["imageMask"], file_size) if body.isDefined("imageMask") else None,
        seconds if math.isfinite(seconds) and seconds > 0 else None,
    )


def _pose(node: Any, kind: str, scans: dict[str, Any], warn: Callable[[str], None]) -> F64:
    """Pose (4, 4) image to file; of a panorama without one, that of the scan that it belongs to."""
    if node.isDefined("pose/rotation") and node.isDefined("pose/translation"):
        return e57.pose_of(node)
    scan = scans.get(_text(node, "associatedData3DGuid"))
    if node.isDefined("pose") or kind == PINHOLE or scan is None or not scan.isDefined("pose/translation"):
        raise _UnusableError("has no pose (rotation and translation)")
    warn("has no pose: that of its scan is used")
    return e57.pose_of(scan)


def _blob(node: Any, file_size: int) -> bytes:
    count = int(node.byteCount())
    if not 0 < count <= file_size:
        raise _UnusableError(f"claims {count:,} bytes, in a file of {file_size:,}")
    data = bytearray(count)
    node.read(data, 0, count)
    return bytes(data)


def _write(
    found: EmbeddedImage, folder: Path, base: str, warn: Callable[[str], None]
) -> tuple[str, str | None, Camera]:
    """Names of photo and mask (or None) in the tile's folder, and the camera.

    Raises:
        InputError, _UnusableError: the image can't be used; nothing is written.
    """
    suffix = ".png" if found.data.startswith(b"\x89PNG") else ".jpg"
    photo, mask = folder / "photos" / f"{base}{suffix}", folder / "masks" / f"{base}.png"
    written = [photo]
    try:
        photo.parent.mkdir(parents=True, exist_ok=True)
        photo.write_bytes(found.data)
        image.check_decodes(photo)
        if (size := image.size_of(photo)) != found.size:
            raise _UnusableError(
                f"is {size[0]} x {size[1]} pixels, but the file says {found.size[0]} x {found.size[1]}"
            )
        if found.mask is not None:
            written.append(mask)
            mask.parent.mkdir(parents=True, exist_ok=True)
            mask.write_bytes(found.mask)
            if (cause := _mask_problem(mask, found.size)) is not None:
                warn(f"is used without its mask: it {cause}")
                mask.unlink()
        camera = _exact_camera(found, warn)
        if camera is None:
            camera = _resampled_camera(found)
            valid = _resample(found, camera, photo, mask if mask.is_file() else None)
            if mask.is_file() or not valid.all():
                written.append(mask)
                mask.parent.mkdir(parents=True, exist_ok=True)
                image.write(mask, valid.astype(np.uint8) * 255)
    except (InputError, _UnusableError):
        for file in written:
            file.unlink(missing_ok=True)
        raise
    return (
        f"photos/{photo.relative_to(folder / 'photos').as_posix()}",
        f"masks/{base}.png" if mask.is_file() else None,
        camera,
    )


def _mask_problem(mask: Path, size: tuple[int, int]) -> str | None:
    try:
        image.check_decodes(mask)
        found = image.size_of(mask)
    except InputError as error:
        return error.cause
    return None if found == size else f"is {found[0]} x {found[1]} pixels"


def _exact_camera(found: EmbeddedImage, warn: Callable[[str], None]) -> Camera | None:
    """Camera of an image that needs no resampling, else None.

    Raises:
        _UnusableError: the image would cover more than the sphere.
    """
    (width, height), numbers = found.size, found.numbers
    if found.kind == PINHOLE:
        fx, fy = numbers["focalLength"] / numbers["pixelWidth"], numbers["focalLength"] / numbers["pixelHeight"]
        if max(fx, fy) > MAX_OFFSET:
            raise _UnusableError(f"has a focal length of {max(fx, fy):g} pixels")
        return Camera(
            "pinhole", width, height, fx, fy, numbers["principalPointX"] - 0.5, numbers["principalPointY"] - 0.5
        )
    angle = min(numbers["pixelWidth"], numbers["pixelHeight"] / numbers.get("radius", 1.0))
    if angle < MIN_PIXEL_ANGLE:
        raise _UnusableError(f"has pixels of {angle:g} rad")
    around = 2 * math.pi / numbers["pixelWidth"]
    if found.kind == SPHERICAL:
        if abs(width - around) < 1 and abs(height - math.pi / numbers["pixelHeight"]) < 1:
            return Camera("equirectangular", width, height)
        angle = width * numbers["pixelWidth"]
        if width == 2 * height and not MIN_SPHERE_ANGLE < angle <= 2 * math.pi:
            warn(f"has an impossible pixel size ({numbers['pixelWidth']:g} rad): taken for a full sphere, as it is 2:1")
            return Camera("equirectangular", width, height)
        if height - math.pi / numbers["pixelHeight"] >= 1:
            raise _UnusableError(f"covers more than the sphere (pixelHeight {numbers['pixelHeight']:g} rad)")
    if width - around >= 1:
        raise _UnusableError(f"covers more than a full circle (pixelWidth {numbers['pixelWidth']:g} rad)")
    return None


def _pixels(found: EmbeddedImage, rays: F64) -> F64:
    """Pixels (N, 2) of an image, spherical or cylindrical, at rays (N, 3) in camera axes."""
    (width, height), numbers = found.size, found.numbers
    x, y, z = rays.T
    flat = np.hypot(x, z)
    u = width / 2 + np.arctan2(x, z) / numbers["pixelWidth"] - 0.5
    if found.kind == SPHERICAL:
        return np.column_stack([u, height / 2 + np.arctan2(y, flat) / numbers["pixelHeight"] - 0.5])
    scale = numbers["radius"] / numbers["pixelHeight"]
    return np.column_stack([u, numbers["principalPointY"] + scale * y / np.maximum(flat, 1e-9) - 0.5])


def _source(found: EmbeddedImage, camera: Camera, rows: slice) -> tuple[F64, F64]:
    """Columns and rows (R, W) of an image, spherical or cylindrical, that a camera's rows see."""
    from scan2sim.pipeline.camera.models import unproject

    columns, lines = np.arange(camera.width), np.arange(rows.start, rows.stop)
    shape = (len(lines), len(columns))
    if camera.model == "equirectangular":  # columns depend on columns alone, and rows on rows: 10 times as fast
        across = np.column_stack([columns, np.full(len(columns), (camera.height - 1) / 2)])
        down = np.column_stack([np.full(len(lines), (camera.width - 1) / 2), lines])
        x, y = _pixels(found, unproject(camera, across))[:, 0], _pixels(found, unproject(camera, down))[:, 1]
        return np.broadcast_to(x, shape), np.broadcast_to(y[:, None], shape)
    v, u = np.meshgrid(lines, columns, indexing="ij")
    x, y = _pixels(found, unproject(camera, np.column_stack([u.ravel(), v.ravel()]))).T
    return x.reshape(shape), y.reshape(shape)


def _angles(found: EmbeddedImage) -> tuple[float, float, float]:
    """Angles in radians to the left and right border, and down to the top and the bottom one."""
    (width, height), numbers = found.size, found.numbers
    across = width / 2 * numbers["pixelWidth"]
    if found.kind == SPHERICAL:
        return across, -height / 2 * numbers["pixelHeight"], height / 2 * numbers["pixelHeight"]
    scale, y = numbers["pixelHeight"] / numbers["radius"], numbers["principalPointY"]
    return across, math.atan(-y * scale), math.atan((height - y) * scale)


def _resampled_camera(found: EmbeddedImage) -> Camera:
    (width, height), numbers = found.size, found.numbers
    across, top, bottom = _angles(found)
    fx, fy = 1 / numbers["pixelWidth"], numbers.get("radius", 1.0) / numbers["pixelHeight"]
    steep = max(-top, bottom)
    if max(across, steep) <= MAX_PINHOLE_ANGLE:
        corner = 1 / math.cos(across)
        low, high = (
            fy * math.tan(angle) * (corner if angle * side > 0 else 1) for angle, side in ((top, -1), (bottom, 1))
        )
        right = fx * math.tan(across)
        shrink = min(1.0, MAX_SIDE / (2 * right), MAX_SIDE / (high - low))
        columns, rows = math.ceil(2 * right * shrink), math.ceil((high - low) * shrink)
        return Camera("pinhole", columns, rows, fx * shrink, fy * shrink, (columns - 1) / 2, -low * shrink - 0.5)
    if found.kind == CYLINDRICAL:  # finer towards its top and bottom than at the horizon
        fy *= min(2.0, 1 / math.cos(steep) ** 2)
    # of the image's parity, so that pixels fall on pixels
    columns = width + 2 * round((2 * math.pi * fx - width) / 2)
    rows = height + 2 * round((math.pi * fy - height) / 2)
    most = min(image.MAX_PIXELS, MAX_GROWTH * width * height)
    shrink = min(1.0, MAX_SIDE / max(columns, rows), math.sqrt(most / (columns * rows)))
    return Camera("equirectangular", max(1, int(columns * shrink)), max(1, int(rows * shrink)))


def _resample(found: EmbeddedImage, camera: Camera, photo: Path, mask: Path | None) -> Bools:
    """Replace a photo by what `camera` sees of it; returns (H, W), False where that is nothing.

    There the border is repeated: black would bleed into smaller versions of the photo, and into JPEG's blocks.
    """
    import cv2

    width, height = found.size
    source = image.read_rgb(photo)
    allowed: U8 | None = None if mask is None else image.read_levels(mask)
    closed = abs(width * found.numbers["pixelWidth"] - 2 * math.pi) < found.numbers["pixelWidth"]
    border = cv2.BORDER_WRAP if closed else cv2.BORDER_REPLICATE
    out = np.empty((camera.height, camera.width, 3), np.uint8)
    valid = np.empty((camera.height, camera.width), bool)
    for top in range(0, camera.height, ROWS):
        rows = slice(top, min(top + ROWS, camera.height))
        x, y = _source(found, camera, rows)
        seen = (x > -0.5 - 1e-6) & (x < width - 0.5 + 1e-6) & (y > -0.5 - 1e-6) & (y < height - 0.5 + 1e-6)
        x, y = x.astype(np.float32), np.clip(y, 0, height - 1).astype(np.float32)  # only the sides may wrap
        out[rows] = cv2.remap(source, x, y, cv2.INTER_LINEAR, borderMode=border)
        if allowed is not None:
            seen &= cv2.remap(allowed, x, y, cv2.INTER_NEAREST, borderMode=border) > 0
        valid[rows] = seen
    if not valid.any():
        raise _UnusableError("shows nothing")
    image.write(photo, out, quality=95)
    return valid
