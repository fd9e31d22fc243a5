"""Where a reconstruction lies on the Earth: by the program's own georeference, or by the photos' GPS.

Both end in a similarity from the model's coordinates to a projected CRS: angles stay as they are, so photos still fit
their points to the pixel. A map projection stretches lengths (UTM by up to 0.04 %), and heights, counted from the
cameras' middle, stretch along with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.geometry.similarity import Similarity, robust
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images import exif

REACH = 15.0
"""Metres between a photo's GPS and its place in the model beyond which the GPS is taken for wrong."""
UNSURE = np.radians(3.0)
"""Of an angle that the track fixes, one standard deviation, beyond which it doesn't fix it."""


@dataclass(frozen=True)
class Fit:
    """A model placed on the Earth.

    Attributes:
        onto: model to CRS.
        crs: its code.
        rms: metres between the photos' places and their GPS, of those that agree; None without GPS.
        used: indices of these photos.
        notes: for the user.
    """

    onto: Similarity
    crs: str
    rms: float | None
    used: list[int]
    notes: tuple[str, ...]


def by_earth(model: Path, T_earth: F64, centres: F64, crs: str | None) -> Fit:
    """Model to CRS, from a similarity (4, 4) to geocentric coordinates; exact at the middle of the (P, 3) centres.

    Raises:
        InputError: the CRS is not projected, or the model lies outside of it.
    """
    from pyproj import Transformer

    middle = centres.mean(axis=0)
    size = float(np.cbrt(np.linalg.det(T_earth[:3, :3])))
    corners = middle + np.vstack([np.zeros(3), 100 / size * np.eye(3)])  # 100 m along each of the model's axes
    xyz = corners @ T_earth[:3, :3].T + T_earth[:3, 3]
    lon, lat, height = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*xyz.T)
    crs, places, _ = _projected(model, crs, np.column_stack([lat, lon, height]))
    u, stretch, vt = np.linalg.svd((places[1:] - places[0]).T * size / 100)
    scale = float(np.sort(stretch)[1])  # two of the three are the projection's, one is the height's
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    notes = []
    if crs_io.has_heights(crs):
        notes.append(
            f"heights are above the ellipsoid, and {crs_io.name(crs)} has others: where they are tens of metres off, "
            "export model and cloud with ellipsoidal heights"
        )
    onto = Similarity(scale, rotation, places[0] - scale * rotation @ middle)
    return Fit(onto, crs, None, list(range(len(centres))), tuple(notes))


def by_photos(model: Path, centres: F64, ups: F64, photos: Sequence[Path], crs: str | None) -> Fit:
    """Model to CRS, by the positions in the photos' EXIF.

    Args:
        model: for messages.
        centres: (P, 3) of the photos, model coordinates.
        ups: (P, 3) up of the photos; used only where the track is straight, so that GPS can't tell its roll.
        photos: their files.
        crs: projected, or None: UTM.

    Raises:
        DataError: fewer than three photos have GPS that agrees, or the track is too short for GPS of that error.
    """
    notes: list[str] = []
    positions = [exif.place(photo) for photo in photos]
    some = [i for i, position in enumerate(positions) if position is not None]
    high = [i for i, position in enumerate(positions) if position is not None and position[2] is not None]
    if len(high) >= 3:
        some = high
    elif some:
        notes.append("the photos' GPS has no altitudes: all of them are taken to be at height 0")
    if len(some) < 3:
        raise DataError(
            model, f"only {len(some)} of {len(photos)} photos have GPS", "Give --upright and --scale instead"
        )
    rows: Any = [positions[i] for i in some]
    crs, target, unit = _projected(model, crs, np.array([(lat, lon, height or 0.0) for lat, lon, height in rows]))
    source, target = centres[some], target * unit  # in metres, as the bounds are
    try:
        onto, near = robust(source, target, REACH)
    except DataError as error:
        raise DataError(model, f"the photos' GPS doesn't fit: {error.cause}", error.remedy) from None
    used = [i for i, good in zip(some, near, strict=True) if good]
    residual = onto.apply(source[near]) - target[near]
    rms = float(np.sqrt((residual**2).sum(axis=1).mean()))
    along, across = _spread(onto.apply(source[near]))
    count = np.sqrt(len(used))
    if not np.arctan2(rms, along * count) < UNSURE:
        raise DataError(
            model,
            f"its photos lie within {2 * along:.1f} m, too little for GPS that is {rms:.1f} m off",
            "Take more photos, further apart, or give --upright and --scale",
        )
    notes.insert(0, f"placed by the GPS of {len(used)} of {len(photos)} photos, {rms:.2f} m off (rms), in {crs}")
    if not np.arctan2(rms, across * count) < UNSURE:
        onto = _rolled(model, onto, source[near], ups)
        notes.append(
            "its photos lie on a line, about which GPS can't tell the roll: the photos' own up is taken for it"
        )
    if len(used) < 0.6 * len(some):
        notes.append(f"the GPS of {len(some) - len(used)} photos is more than {REACH:g} m off, and was left out")
    return Fit(Similarity(onto.scale / unit, onto.rotation, onto.translation / unit), crs, rms, used, tuple(notes))


def _projected(model: Path, crs: str | None, places: F64) -> tuple[str, F64, float]:
    """CRS (default: UTM), coordinates in its units and metres of one, of (N, 3) latitudes, longitudes, heights (m)."""
    from pyproj import Transformer

    lat, lon, height = places.T
    crs = crs or crs_io.utm(float(np.median(lat)), float(np.median(lon)))
    if crs == crs_io.LOCAL:
        raise InputError(model, "lies on the Earth, and can't be brought to local coordinates", "Name a projected CRS")
    _, unit = crs_io.common(model, crs, None, (), ())
    east, north = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    out = np.column_stack([east, north, height / unit])
    if not np.isfinite(out).all():
        raise InputError(model, f"lies outside of {crs_io.name(crs)}", "Name another CRS")
    return crs, out, unit


def _spread(places: F64) -> tuple[float, float]:
    """Standard deviations of places along their longest direction and across it, in their plane."""
    values = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) / np.sqrt(len(places))
    return float(values[0]), float(values[1])


def _rolled(model: Path, onto: Similarity, places: F64, ups: F64) -> Similarity:
    """Turned about the line of the places, so that the photos' mean up is upwards."""
    from scipy.spatial.transform import Rotation

    line = np.linalg.svd(places - places.mean(axis=0))[2][0]
    axis = onto.rotation @ line
    up = onto.rotation @ ups.mean(axis=0)
    a, b = up - axis * (up @ axis), np.array([0.0, 0.0, 1.0]) - axis * axis[2]
    if min(np.linalg.norm(a), np.linalg.norm(b)) < 0.1:
        raise DataError(model, "its photos lie on a line, and tell no up", "Give --upright and --scale instead")
    angle = np.arctan2(np.cross(a, b) @ axis, a @ b)
    turn = Rotation.from_rotvec(axis * angle).as_matrix()
    middle = places.mean(axis=0)
    rotation = turn @ onto.rotation
    return Similarity(onto.scale, rotation, onto.apply(middle[None])[0] - onto.scale * rotation @ middle)
