"""E57 clouds (ASTM E2807), read with pye57: all scans of a file, each transformed by its own pose.

Supported: Cartesian and spherical coordinates; colours and intensities, scaled by each scan's limits; times relative to
`acquisitionStart`; a field `classification`, which some writers add. The CRS is read from `coordinateMetadata` if that
contains one. Points that a scan marks as invalid are removed, colours that it marks as invalid are unknown.

Source: ASTM E2807-11, tables 1 to 20 (as in libE57Format's documentation, https://github.com/asmaloney/libE57Format).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io import file_checks, point_chunks
from scan2sim.pipeline.io.point_chunks import READ_POINTS, Points

SUFFIXES = (".e57",)
NEEDS = ("pye57",)
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLOURS = ("colorRed", "colorGreen", "colorBlue")
INVALID = ("cartesianInvalidState", "sphericalInvalidState")
COLOUR_INVALID = "isColorInvalid"
OPTIONAL_FIELDS = ("intensity", "timeStamp", "classification", COLOUR_INVALID)


def read_header(path: Path) -> tuple[int, F64, F64, str | None, tuple[str, ...]]:
    """Number of valid points of all scans, low and high corner, CRS as WKT or None, and notes."""
    found = point_chunks.summary(path, parts(path))
    return found.count, found.low, found.high, _crs(path), found.notes


def parts(path: Path) -> Iterator[Points]:
    """The points of all scans, in chunks.

    Raises:
        InputError: not a readable E57 file.
    """
    with closing(open_file(path)) as file:
        try:
            scans = file.root()["data3D"]
            for i in range(len(scans)):
                yield from _scan(file, scans[i], i)
        except InputError:
            raise
        except Exception as error:  # pye57's own type, or any other that its bindings raise for damaged files
            raise _unreadable(path, error) from None


def open_file(path: Path) -> Any:
    """Open an E57 file: a libe57 `ImageFile`.

    Raises:
        InputError: it doesn't exist, or isn't an E57 file.
    """
    from pye57 import libe57  # pye57's class E57 deletes files that it can't open

    file_checks.check(path)
    try:
        return libe57.ImageFile(str(path), "r")
    except Exception as error:  # pye57's own type, or any other that its bindings raise for damaged files
        raise _unreadable(path, error) from None


def _scan(file: Any, node: Any, number: int) -> Iterator[Points]:
    from pye57 import libe57
    from pye57.scan_header import ScanHeader

    header = ScanHeader(node)
    available = set(header.point_fields)
    coordinates = next((names for names in (CARTESIAN, SPHERICAL) if set(names) <= available), None)
    if coordinates is None:
        raise ValueError(f"a scan has neither {', '.join(CARTESIAN)} nor {', '.join(SPHERICAL)}")
    wanted = [*coordinates, *(name for name in (*COLOURS, *INVALID, *OPTIONAL_FIELDS) if name in available)]
    values = {name: np.empty(READ_POINTS) for name in wanted}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in values.items():
        buffers.append(libe57.SourceDestBuffer(file, name, array, READ_POINTS, True, True))
    pose = pose_of(node)
    done = 0
    with closing(header.points.reader(buffers)) as reader:
        while n := reader.read():
            done += n
            yield _points({name: array[:n].copy() for name, array in values.items()}, coordinates, pose, node, number)
    if done != header.point_count:
        raise ValueError(f"{done:,} of {header.point_count:,} points of a scan can be read")


def _points(values: dict[str, F64], coordinates: tuple[str, ...], pose: F64, node: Any, number: int) -> Points:
    xyz = np.column_stack([values[name] for name in coordinates])
    if coordinates is SPHERICAL:
        distance, azimuth, elevation = xyz.T
        flat = distance * np.cos(elevation)
        xyz = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)])
    for name in INVALID:
        if name in values:
            xyz[values[name] != 0] = np.nan
    rgb: npt.NDArray[Any] | None = None
    if set(COLOURS) <= set(values):
        rgb = np.column_stack([_fraction(values[name], node, "colorLimits", name) for name in COLOURS])
        if COLOUR_INVALID in values:
            rgb[values[COLOUR_INVALID] != 0] = np.nan
    intensity = values.get("intensity")
    if intensity is not None:
        intensity = _fraction(intensity, node, "intensityLimits", "intensity")
    time = values.get("timeStamp")
    if time is not None and node.isDefined("acquisitionStart/dateTimeValue"):
        time = time + number_of(node["acquisitionStart"]["dateTimeValue"])
    return Points(
        xyz @ pose[:3, :3].T + pose[:3, 3],
        rgb,
        classification=values.get("classification"),
        time=time,
        intensity=intensity,
        scan=number,
    )


def _fraction(values: F64, node: Any, limits: str, name: str) -> F64:
    """Values scaled from the scan's limits to 0..1; unchanged if it declares no limits."""
    if not node.isDefined(f"{limits}/{name}Maximum") or not node.isDefined(f"{limits}/{name}Minimum"):
        return values
    low, high = (number_of(node[limits][f"{name}{end}"]) for end in ("Minimum", "Maximum"))
    return (values - low) / (high - low) if high > low else values


def number_of(node: Any) -> float:
    """Value of a number of any type; FARO SCENE writes the limits of intensities as scaled integers."""
    return float(node.scaledValue() if hasattr(node, "scaledValue") else node.value())


def pose_of(node: Any) -> F64:
    """Transform (4, 4) of a scan or image to file coordinates; the identity if it has no pose.

    Raises:
        ValueError: the pose contains NaN or infinity, or a quaternion of zeros.
    """
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    if node.isDefined("pose/rotation"):
        w, x, y, z = (number_of(node["pose"]["rotation"][key]) for key in "wxyz")
        pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    if node.isDefined("pose/translation"):
        pose[:3, 3] = [number_of(node["pose"]["translation"][key]) for key in "xyz"]
    if not np.isfinite(pose).all():
        raise ValueError("a pose is not finite")
    return pose


def _crs(path: Path) -> str | None:
    """CRS of `coordinateMetadata` as WKT; None if it is empty or, as many writers do, contains a remark instead."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    with closing(open_file(path)) as file:
        root = file.root()
        text = str(root["coordinateMetadata"].value()) if root.isDefined("coordinateMetadata") else ""
    try:
        return CRS.from_user_input(text).to_wkt() if text.strip() else None
    except CRSError:
        return None


def _unreadable(path: Path, error: Exception) -> InputError:
    cause = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    return InputError(path, f"is not a readable E57 file ({cause[:160]})", "Export it again, or as LAZ")
