"""Agisoft Metashape models, `cameras.xml` (Export Cameras, Agisoft XML).

A camera's `transform` is camera to chunk, row-major, with OpenCV's axes. Its component's `transform` (rotation, scale,
translation), or the chunk's if it has none, maps to geocentric coordinates, in the datum of the chunk's `reference` if
that is a CRS of the Earth, and to the reference's own coordinates if it is local. Only the largest of several
components is read.

In a multi-camera system only the master camera has a `transform`; the others name it (`master_id`), and their sensor
has `rotation` and `translation`, from its own axes to those of the master's, in the chunk's units. The camera model:

    u = w/2 + cx + x' f + x' b1 + y' b2,  v = h/2 + cy + y' f
    x' = x (1 + k1 r2 + k2 r4 + k3 r6 + k4 r8) + p1 (r2 + 2 x2) + 2 p2 x y
    y' = y (1 + k1 r2 + k2 r4 + k3 r6 + k4 r8) + p2 (r2 + 2 y2) + 2 p1 x y

so that its p1, p2 are OpenCV's p2, p1; the centre of the top left pixel is (0.5, 0.5). For `fisheye`, the length of
(x, y) is the angle to the axis instead of its tangent. OpenCV has no such k4: if there is one, OpenCV's k1...k6 are
fitted to the same distortion; the camera is rejected if the fit error exceeds 0.05 pixels. b2 isn't supported.

Source: Metashape Professional user manual 2.1, appendix D, Camera models; `CoordinateSystem.geoccs` of its Python API.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from scan2sim.pipeline.camera import distortion_fit
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.geometry.similarity import Similarity
from scan2sim.pipeline.io import xml
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.photogrammetry import Model, Photos, Shot

REMEDY = "Export it again (File > Export > Export Cameras, Agisoft XML)"
UNDISTORT = "Undistort the photos in Metashape and export them with their cameras, or calibrate without that parameter"


def read(model: Path, photos: Photos) -> Model:
    """Read the cameras.xml of one chunk; photos that are disabled or not aligned are left out."""
    chunk = _chunk(model)
    try:
        sensors = {str(sensor.get("id")): sensor for sensor in chunk.iterfind("sensors/sensor")}
        enabled = [
            camera for camera in chunk.iterfind("cameras//camera") if camera.get("enabled", "1") in ("1", "true")
        ]
        by_id = {str(camera.get("id")): camera for camera in chunk.iterfind("cameras//camera")}
        poses = {id(camera): _pose(camera, by_id, sensors) for camera in enabled}
        aligned = [camera for camera in enabled if poses[id(camera)] is not None]
        composed = sum(camera.find("transform") is None for camera in aligned)
        components = {c.get("id"): _similarity(c.find("transform")) for c in chunk.iterfind("components/component")}
        component = {id(camera): _component(camera, by_id) for camera in aligned}
        component_sizes = Counter(component.values())
        largest = component_sizes.most_common(1)[0][0] if component_sizes else None
        in_smaller = [camera for camera in aligned if component[id(camera)] != largest]
        aligned = [camera for camera in aligned if component[id(camera)] == largest]
        cameras, shots = {}, []
        for camera in aligned:
            key = str(camera.get("sensor_id"))
            if key not in sensors:
                raise ValueError(f"camera {camera.get('label')}: its sensor {key} is missing")
            if f"sensor_{key}" not in cameras:
                cameras[f"sensor_{key}"] = _camera(model, sensors[key])
            pose = poses[id(camera)]
            assert pose is not None
            _check_rotation(pose[:3, :3], str(camera.get("label")))
            shots.append(Shot(str(camera.get("label")), f"sensor_{key}", pose))
        onto = components.get(largest) or _similarity(chunk.find("transform"))
        reference = (chunk.findtext("reference") or "").strip()
    except (TypeError, ValueError, KeyError) as error:
        raise InputError(model, f"has missing or invalid values: {str(error)[:120]}", REMEDY) from None
    notes = []
    if composed:
        notes.append(f"{composed} photos of multi-camera systems are placed by their master's pose and sensor's offset")
    if in_smaller:
        notes.append(f"{len(in_smaller)} photos of {len(component_sizes) - 1} smaller components are left out")
    if len(enabled) > len(aligned) + len(in_smaller):
        notes.append(f"{len(enabled) - len(aligned) - len(in_smaller)} photos without a pose are left out")
    found = Model(cameras, tuple(shots), np.empty((0, 3)), notes=tuple(notes))
    if onto is None:
        return found
    if not reference or reference.startswith("LOCAL"):
        return found.transformed(onto)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = onto.scale * onto.rotation, onto.translation
    crs, datum = _reference(model, reference)
    return replace(found, rgb=None, T_earth=T, crs=crs, datum=datum)


def _pose(camera: Element, cameras: Mapping[str, Element], sensors: Mapping[str, Element]) -> F64 | None:
    """Pose (4, 4) of a camera to the chunk: its own, or its master's with the offset of its sensor; None: unknown."""
    if camera.find("transform") is not None:
        return np.array(_numbers(camera.find("transform"), 16)).reshape(4, 4)
    master, sensor = cameras.get(str(camera.get("master_id"))), sensors.get(str(camera.get("sensor_id")))
    if master is None or master.find("transform") is None or sensor is None or sensor.find("translation") is None:
        return None
    offset = np.eye(4)
    offset[:3, :3] = np.array(_numbers(sensor.find("rotation"), 9)).reshape(3, 3)
    offset[:3, 3] = _numbers(sensor.find("translation"), 3)
    return np.array(_numbers(master.find("transform"), 16)).reshape(4, 4) @ offset


def _component(camera: Element, cameras: Mapping[str, Element]) -> str | None:
    """Component of a camera: its own, or its master's."""
    return camera.get("component_id", cameras.get(str(camera.get("master_id")), camera).get("component_id"))


def _chunk(model: Path) -> Element:
    chunks = [chunk for chunk in xml.root(model, REMEDY).iter("chunk") if chunk.find("cameras") is not None]
    if len(chunks) != 1:
        cause = f"contains {len(chunks)} chunks with cameras"
        raise InputError(model, cause, "Export the cameras of one chunk as Agisoft XML")
    return chunks[0]


def _numbers(node: Element | None, count: int) -> list[float]:
    if node is None or node.text is None:
        raise ValueError(f"{count} numbers")
    values = [float(value) for value in node.text.split()]
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{count} numbers of `{node.tag}`")
    return values


def _similarity(node: Element | None) -> Similarity | None:
    if node is None or node.find("rotation") is None:
        return None
    rotation = np.array(_numbers(node.find("rotation"), 9)).reshape(3, 3)
    _check_rotation(rotation, "transform")
    scale = _numbers(node.find("scale"), 1)[0] if node.find("scale") is not None else 1.0
    if not scale > 0:
        raise ValueError("the scale of `transform`")
    return Similarity(scale, rotation, np.array(_numbers(node.find("translation"), 3)))


def _check_rotation(R: F64, where: str) -> None:
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise ValueError(f"{where}: its rotation matrix is invalid")


def _camera(model: Path, sensor: Element) -> Camera:
    title = f"sensor {sensor.get('label') or sensor.get('id')}"
    resolution = sensor.find("resolution")
    if resolution is None:
        raise ValueError(f"{title}: its resolution")
    width, height = int(resolution.get("width") or 0), int(resolution.get("height") or 0)
    if min(width, height) < 1:
        raise ValueError(f"{title}: its resolution")
    kind = sensor.get("type", "frame")
    if kind == "spherical":
        return Camera("equirectangular", width, height)
    if kind not in ("frame", "fisheye"):
        raise InputError(model, f"{title} is of type {kind!r}, which is not supported", UNDISTORT)
    found = {str(node.get("class", "adjusted")): node for node in sensor.iterfind("calibration")}
    calibration = found.get("adjusted", found.get("initial"))
    if calibration is None:
        raise InputError(model, f"{title} has no calibration", "Align the photos, and export the cameras again")
    value = {node.tag: float(node.text or 0) for node in calibration if node.tag != "resolution"}
    f = value.get("f") or value.get("fy") or 0.0
    if not (np.isfinite(list(value.values())).all() and f > 0):
        raise ValueError(f"{title}: its focal length")
    fx, cx, cy = f + value.get("b1", 0.0), value.get("cx", 0.0), value.get("cy", 0.0)
    cx, cy = width / 2 + cx - 0.5, height / 2 + cy - 0.5
    k1, k2, k3, k4, p1, p2, p3, p4, b2 = (
        value.get(n, 0.0) for n in ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b2")
    )
    max_radius = distortion_fit.max_distorted_radius(width, height, fx, f, cx, cy)
    unsupported = {"b2": b2 * max(cy, height - cy) / f, "p3, p4": f * max(abs(p3), abs(p4)) * max_radius**4}
    if kind == "fisheye":
        unsupported["p1, p2 of a fisheye"] = f * 3 * max(abs(p1), abs(p2)) * max_radius**2
    for name, pixels in unsupported.items():
        if abs(pixels) > 0.01:
            raise InputError(
                model, f"{title} has {name} (up to {abs(pixels):.2f} pixels), which is not supported", UNDISTORT
            )
    if kind == "fisheye":
        return Camera("fisheye", width, height, fx, f, cx, cy, (k1, k2, k3, k4))
    k: tuple[float, ...] = (k3,)
    if k4:
        factor = np.polynomial.Polynomial([1, k1, k2, k3, k4])
        undistorted_radius = _undistorted(factor, max_radius)
        fitted, fit_error = distortion_fit.fit_radial(lambda r: np.asarray(factor(r * r)), undistorted_radius, f)
        if fit_error > distortion_fit.MAX_FIT_ERROR_PX:
            cause = f"{title}: k1 to k4 fit OpenCV's model with an error of {fit_error:.3f} pixels"
            raise InputError(model, cause, UNDISTORT)
        k1, k2, *rest = fitted.tolist()
        k = tuple(rest)
    return Camera("opencv", width, height, fx, f, cx, cy, (k1, k2, p2, p1, *k))


def _undistorted(factor: np.polynomial.Polynomial, max_radius: float) -> float:
    """Undistorted radius of the distorted `max_radius`, or where the distortion folds back, if that is smaller."""
    r = np.linspace(0, 3 * max_radius, 3000)
    distorted = r * np.asarray(factor(r * r))
    beyond = np.flatnonzero((distorted >= max_radius) | (np.gradient(distorted, r) <= 0))
    return float(r[beyond[0]]) if len(beyond) else float(r[-1])


def _reference(model: Path, reference: str) -> tuple[str | None, str | None]:
    """The chunk's CRS if it is projected, else None; and its geographic CRS as WKT, None for WGS 84."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        crs = CRS.from_user_input(reference)
        own = crs.source_crs if crs.is_bound and crs.source_crs is not None else crs  # without its shift to WGS 84
        geographic = own.geodetic_crs
        if geographic is None:
            raise CRSError("it has no datum")
    except CRSError as error:
        raise InputError(model, f"its reference is not a valid CRS ({str(error)[:80]})", REMEDY) from None
    meridian = geographic.prime_meridian
    if meridian is not None and meridian.longitude:
        cause = f"its reference {crs.name} counts longitudes from {meridian.name}, which is not supported"
        raise InputError(model, cause, "Convert the chunk to another coordinate system, and export the cameras again")
    wgs84 = geographic.to_2d().equals(CRS.from_epsg(4326), ignore_axis_order=True)
    projected = crs_io.short(crs.to_wkt()) if crs.is_projected else None
    return projected, None if wgs84 else geographic.to_2d().to_wkt()
