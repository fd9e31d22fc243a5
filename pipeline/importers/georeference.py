"""Georeferencing of reconstructions, by the program's own georeference or by the photos' GPS.

Both result in a similarity from model coordinates to a projected CRS, which preserves angles, so that photos still fit
their points to the pixel. A map projection scales lengths (UTM by up to 0.04 %); heights relative to the cameras'
mean are scaled by the same factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.geometry.similarity import Similarity, fit_robust
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images import exif

if TYPE_CHECKING:
    from pyproj import CRS

MAX_GPS_RESIDUAL_M = 15.0
"""Distance between a photo's GPS position and its position in the model above which the GPS is an outlier."""
MAX_ANGLE_SIGMA_RAD = np.radians(3.0)
"""Standard deviation of an angle above which the GPS track doesn't determine it."""

WGS84 = "EPSG:4326"


@dataclass(frozen=True)
class Fit:
    """A georeferenced model.

    Attributes:
        onto: similarity from model to CRS coordinates.
        crs: code of the CRS.
        rms: distance (m) between photos and their GPS positions, inliers only; None without GPS.
        used: indices of the photos whose GPS was used.
        notes: messages for the user.
    """

    onto: Similarity
    crs: str
    rms: float | None
    used: list[int]
    notes: tuple[str, ...]


def from_geocentric(model: Path, T_earth: F64, centres: F64, crs: str | None, datum: str | None = None) -> Fit:
    """Georeference by a similarity (4, 4) to geocentric coordinates; exact at the mean of the camera centres (P, 3).

    Args:
        model: the model's file, for messages.
        T_earth: similarity from the model to geocentric coordinates, metres.
        centres: camera centres, model coordinates.
        crs: projected CRS; None: UTM.
        datum: geographic CRS of the geocentric coordinates, in degrees from Greenwich; None: WGS 84.

    Raises:
        InputError: the CRS is not projected, or the model is outside of its area.
    """
    middle = centres.mean(axis=0)
    model_scale = float(np.cbrt(np.linalg.det(T_earth[:3, :3])))
    corners = middle + np.vstack([np.zeros(3), 100 / model_scale * np.eye(3)])  # 100 m along each of the model's axes
    xyz = corners @ T_earth[:3, :3].T + T_earth[:3, 3]
    geographic = _geographic(xyz, datum)
    crs, projected, _ = _projected(model, crs, geographic, datum or WGS84)
    u, stretch, vt = np.linalg.svd((projected[1:] - projected[0]).T * model_scale / 100)
    scale = float(np.sort(stretch)[1])  # two of the three are those of the projection, one is that of the height
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    notes = []
    if crs_io.has_heights(crs):
        notes.append(
            f"heights are above the ellipsoid, but {crs_io.name(crs)} defines another height system: if they are off "
            "by tens of metres, export model and cloud with ellipsoidal heights"
        )
    if datum is not None and not _same_ellipsoid(datum, crs):
        notes.append(f"heights stay those of {crs_io.name(datum)}, whose ellipsoid is not that of {crs_io.name(crs)}")
    onto = Similarity(scale, rotation, projected[0] - scale * rotation @ middle)
    return Fit(onto, crs, None, list(range(len(centres))), tuple(notes))


def _geographic(xyz: F64, datum: str | None) -> F64:
    """Latitudes, longitudes (degrees) and heights (N, 3) of geocentric positions on the ellipsoid of a datum."""
    from pyproj import Transformer

    if datum is None:
        to_degrees = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    else:
        ellipsoid = _own_datum(datum).ellipsoid
        assert ellipsoid is not None
        axes = f"+a={ellipsoid.semi_major_metre!r} +b={ellipsoid.semi_minor_metre!r}"
        degrees = "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
        to_degrees = Transformer.from_pipeline(f"+proj=pipeline +step +inv +proj=cart {axes} {degrees}")
    x, y, z = xyz.T
    lon, lat, height = to_degrees.transform(x, y, z)
    return np.column_stack([lat, lon, height])


def _same_ellipsoid(first: str, second: str) -> bool:
    a, b = (_own_datum(crs).ellipsoid for crs in (first, second))
    return a is not None and b is not None and abs(a.semi_major_metre - b.semi_major_metre) < 1e-3


def _own_datum(crs: str) -> CRS:
    """A CRS without the shift to WGS 84 that its WKT may have (TOWGS84)."""
    from pyproj import CRS

    parsed = CRS.from_user_input(crs)
    return parsed.source_crs if parsed.is_bound and parsed.source_crs is not None else parsed


def from_photo_gps(model: Path, centres: F64, ups: F64, photos: Sequence[Path], crs: str | None) -> Fit:
    """Georeference by the GPS positions in the photos' EXIF.

    Args:
        model: the model's file, for messages.
        centres: (P, 3) camera centres of the photos, model coordinates.
        ups: (P, 3) up directions of the photos; used only if the track is straight and GPS doesn't determine its roll.
        photos: their files.
        crs: projected CRS; None: UTM.

    Raises:
        DataError: fewer than three photos have consistent GPS, or the track is too short for the error of the GPS.
    """
    crs, positions, unit, notes = photo_positions(model, photos, crs)
    fit = from_positions(model, centres, ups, positions, crs, unit)
    return replace(fit, notes=(fit.notes[0], *notes, *fit.notes[1:]))


def photo_positions(model: Path, photos: Sequence[Path], crs: str | None) -> tuple[str, F64, float, list[str]]:
    """Positions by the GPS in the photos' EXIF.

    Args:
        model: file or folder, for messages.
        photos: files.
        crs: projected CRS; None: UTM.

    Returns:
        The CRS, positions (P, 3) in metres along its axes (NaN where unknown), metres per unit, notes for the user.

    Raises:
        DataError: fewer than three photos have GPS. InputError: they are outside of the area of the CRS.
    """
    notes: list[str] = []
    found = [exif.gps_position(photo) for photo in photos]
    located = [i for i, position in enumerate(found) if position is not None]
    with_altitude = [i for i, position in enumerate(found) if position is not None and position[2] is not None]
    if len(with_altitude) >= 3:
        located = with_altitude
    elif located:
        notes.append("the photos' GPS has no altitudes: height 0 is assumed for all of them")
    if len(located) < 3:
        raise DataError(
            model, f"only {len(located)} of {len(photos)} photos have GPS", "Give --upright and --scale instead"
        )
    rows: Any = [found[i] for i in located]
    crs, target, unit = _projected(model, crs, np.array([(lat, lon, height or 0.0) for lat, lon, height in rows]))
    positions = np.full((len(photos), 3), np.nan)
    positions[located] = target * unit  # metres, the unit of the limits
    return crs, positions, unit, notes


def from_positions(
    model: Path,
    centres: F64,
    ups: F64,
    positions: F64,
    crs: str,
    unit: float = 1.0,
    *,
    max_angle: float = MAX_ANGLE_SIGMA_RAD,
    remedy: str = "or give --upright and --scale",
) -> Fit:
    """Georeference by the photos' approximate positions.

    Args:
        model: the model's file, for messages.
        centres, ups: as of `from_photo_gps`.
        positions: (P, 3) metres along the axes of the CRS; NaN where unknown.
        crs: their CRS.
        unit: metres per unit of the CRS.
        max_angle: standard deviation of the heading (rad) above which the positions don't determine it.
        remedy: end of the remedy in messages.

    Raises:
        DataError: fewer than three positions are consistent, or the track is too short for their error.
    """
    notes: list[str] = []
    located = np.flatnonzero(np.isfinite(positions).all(axis=1)).tolist()
    source, target = centres[located], positions[located]
    try:
        onto, inlier = fit_robust(source, target, MAX_GPS_RESIDUAL_M)
    except DataError as error:
        raise DataError(model, f"the photos' GPS doesn't fit: {error.cause}", error.remedy) from None
    used = [i for i, good in zip(located, inlier, strict=True) if good]
    residual = onto.apply(source[inlier]) - target[inlier]
    rms = float(np.sqrt((residual**2).sum(axis=1).mean()))
    along, across = _spread(onto.apply(source[inlier]))
    count = np.sqrt(len(used))
    if not np.arctan2(rms, along * count) < max_angle:
        raise DataError(
            model,
            f"its photos extend over {2 * along:.1f} m, too little for GPS with an error of {rms:.1f} m",
            f"Take more photos, further apart, {remedy}",
        )
    notes.insert(0, f"georeferenced by the GPS of {len(used)} of {len(centres)} photos, rms {rms:.2f} m, in {crs}")
    if not np.arctan2(rms, across * count) < MAX_ANGLE_SIGMA_RAD:
        onto = _with_roll(model, onto, source[inlier], ups)
        notes.append(
            "its photos are on a line, so GPS doesn't determine the roll about it: the photos' up direction is used"
        )
    if len(used) < 0.6 * len(located):
        rejected = len(located) - len(used)
        notes.append(f"the GPS of {rejected} photos is off by more than {MAX_GPS_RESIDUAL_M:g} m and was rejected")
    return Fit(Similarity(onto.scale / unit, onto.rotation, onto.translation / unit), crs, rms, used, tuple(notes))


def _projected(model: Path, crs: str | None, geographic: F64, source: str = WGS84) -> tuple[str, F64, float]:
    """Project (N, 3) latitudes, longitudes, heights (m); returns CRS (default: UTM), coordinates, metres per unit.

    `source` is their geographic CRS.
    """
    from pyproj import Transformer

    lat, lon, height = geographic.T
    crs = crs or crs_io.utm(float(np.median(lat)), float(np.median(lon)))
    if crs == crs_io.LOCAL:
        raise InputError(model, "is georeferenced, so the CRS can't be local", "Give a projected CRS")
    _, unit = crs_io.common(model, crs, None, (), ())
    target = crs if source == WGS84 else _own_datum(crs)
    east, north = Transformer.from_crs(source, target, always_xy=True).transform(lon, lat)
    out = np.column_stack([east, north, height / unit])
    if not np.isfinite(out).all():
        raise InputError(model, f"is outside of the area of {crs_io.name(crs)}", "Give another CRS")
    return crs, out, unit


def _spread(positions: F64) -> tuple[float, float]:
    """Standard deviations of positions along their first and second principal axis."""
    values = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False) / np.sqrt(len(positions))
    return float(values[0]), float(values[1])


def _with_roll(model: Path, onto: Similarity, positions: F64, ups: F64) -> Similarity:
    """The similarity rotated about the line through the positions, so that the photos' mean up direction is +z."""
    from scipy.spatial.transform import Rotation

    line = np.linalg.svd(positions - positions.mean(axis=0))[2][0]
    axis = onto.rotation @ line
    up = onto.rotation @ ups.mean(axis=0)
    a, b = up - axis * (up @ axis), np.array([0.0, 0.0, 1.0]) - axis * axis[2]
    if min(np.linalg.norm(a), np.linalg.norm(b)) < 0.1:
        raise DataError(
            model, "its photos are on a line and have no common up direction", "Give --upright and --scale instead"
        )
    angle = np.arctan2(np.cross(a, b) @ axis, a @ b)
    roll = Rotation.from_rotvec(axis * angle).as_matrix()
    middle = positions.mean(axis=0)
    rotation = roll @ onto.rotation
    return Similarity(onto.scale, rotation, onto.apply(middle[None])[0] - onto.scale * rotation @ middle)
