"""Camera calibrations of other programs: Kalibr, ROS, OpenCV, direct_visual_lidar_calibration, FAST-LIVO, VINS.

Files are YAML, JSON or OpenCV's XML; which program wrote one is found by its keys. All of these count pixels from the
centre of the top left one, and their axes are x right, y down, z ahead, so only names and directions are converted:

| program | camera | extrinsics |
| --- | --- | --- |
| Kalibr, `camchain.yaml` | `camN`: `intrinsics`, `distortion_coeffs`, `resolution` | none of a lidar |
| ROS, `camera_info` or a CameraInfo as text | `camera_matrix`, `distortion_coefficients`, or K, D, P | none |
| OpenCV's FileStorage, Autoware.AI | the same, or `CameraMat`, `DistCoeff` | `CameraExtrinsicMat`, T_scanner_camera |
| direct_visual_lidar_calibration, `calib.json` | `camera` | `T_lidar_camera`: x y z qx qy qz qw |
| FAST-LIVO, FAST-LIVO2 | `cam_fx`, `cam_d0`, ... | `Rcl`, `Pcl`: T_camera_scanner |
| camodocal (VINS, LVI-SAM) | `model_type`, `projection_parameters` | none |
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from scan2sim.pipeline.camera.distortion_fit import (
    MAX_FIT_ERROR_PX,
    double_sphere_radius,
    extended_unified_radius,
    field_of_view_radius,
    fit_fisheye,
    max_distorted_radius,
)
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.io import file_checks, xml
from scan2sim.pipeline.io.camera_info import InvalidCamera, camera_of, check_model, distortion_of

SUFFIXES = (".yaml", ".yml", ".json", ".xml")
KNOWN = "a calibration of Kalibr, ROS (camera_info), OpenCV, direct_visual_lidar_calibration, FAST-LIVO or VINS"
REMEDY = "docs/inputs.md lists the calibrations that are read; or write [[cameras]] in a TOML file as in a tile.toml"
OTHER_LENS = (
    "Calibrate it again as pinhole with radtan, or with equidistant if the lens is wide (Kalibr: pinhole-radtan, "
    "pinhole-equi)"
)
MAX_BYTES = 2_000_000
MAX_LENGTH = 100
"""Most numbers of a matrix, and entries of a list of cameras."""
MAX_OFF_CENTRE = 0.2
"""Largest distance of a principal point from the middle of the image, as a share of its size, that shows that a file
which doesn't state its image size belongs to photos of this size."""
MAX_SKEW_PX = 0.1
LIVO_MODELS = {
    "pinhole": ("plumb_bob", ("cam_d0", "cam_d1", "cam_d2", "cam_d3")),
    "equidistantcamera": ("equidistant", ("k1", "k2", "k3", "k4")),
}
"""Camera models of FAST-LIVO in lower case: distortion model, and keys of its coefficients (0 if missing)."""
SYMMETRIC_MODELS = {"ds": double_sphere_radius, "eucm": extended_unified_radius}
"""Models of Kalibr with two parameters before the focal lengths."""
CAMODOCAL_MODELS = {
    "PINHOLE": ("plumb_bob", "distortion_parameters", ("k1", "k2", "p1", "p2"), ("fx", "fy", "cx", "cy")),
    "KANNALA_BRANDT": ("fisheye", "projection_parameters", ("k2", "k3", "k4", "k5"), ("mu", "mv", "u0", "v0")),
}
"""Camera models of camodocal: distortion model, table and keys of its coefficients, keys of the intrinsics."""
Tree = Mapping[str, Any]


@dataclass(frozen=True)
class CalibratedCamera:
    """A camera of a calibration file.

    Attributes:
        names: what the file calls it: an id, and the topic of its images.
        camera: its intrinsics.
        rectified: intrinsics of its rectified images, if the file has them.
    """

    names: tuple[str, ...]
    camera: Camera
    rectified: Camera | None = None


def file_of(camera: str) -> Path | None:
    """The file that the option of a camera names, if it isn't a camera model."""
    path = Path(camera)
    return path if path.suffix.lower() in (".toml", *SUFFIXES) or path.is_file() else None


def read_cameras(path: Path, size: tuple[int, int]) -> list[CalibratedCamera]:
    """Cameras of a calibration file.

    Args:
        path: the file.
        size: width and height of the photos, which applies if the file doesn't state the size of its images.

    Raises:
        InputError: it isn't known, damaged, or has a model that no camera here can represent.
    """
    tree = _tree(path)
    try:
        for reader in (_kalibr, _direct_visual, _fast_livo, _camodocal, _matrices):
            found = list(reader(tree, size))
            if found:
                return found
    except InvalidCamera as error:
        raise InputError(path, str(error), OTHER_LENS if "no counterpart" in str(error) else REMEDY) from None
    raise InputError(path, f"is not {KNOWN} (its keys: {_listed(tree)})", REMEDY)


def read_extrinsics(path: Path) -> F64:
    """T_camera_scanner (4, 4), scanner axes to camera axes, not orthonormalized, of a calibration file.

    Raises:
        InputError: it has no transform between a scanner and one camera.
    """
    tree = _tree(path)
    remedy = "Write T_camera_scanner in a text file: three rows of four numbers, scanner axes to camera axes"
    results, livo, own = _table(tree, "results"), _livo_extrinsics(tree), _plain_keys(tree)
    try:
        if "T_lidar_camera" in results:
            return np.asarray(np.linalg.inv(_pose(_numbers(results, "T_lidar_camera", 7))), np.float64)
        if "Rcl" in livo:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = _numbers(livo, "Rcl", 9).reshape(3, 3), _numbers(livo, "Pcl", 3)
            return T
        if "cameraextrinsicmat" in own:
            return np.asarray(np.linalg.inv(_numbers(own, "cameraextrinsicmat", 16).reshape(4, 4)), np.float64)
    except InvalidCamera as error:
        raise InputError(path, str(error), remedy) from None
    except np.linalg.LinAlgError:
        raise InputError(path, "its extrinsics are not a rigid transform", remedy) from None
    if any("T_cam_imu" in entry for _, entry in _kalibr_entries(tree)):
        raise InputError(path, "has the cameras' poses in the IMU's axes, and no scanner", remedy)
    if "camera" in tree and not results.keys().isdisjoint(("init_T_lidar_camera", "init_T_lidar_camera_auto")):
        raise InputError(path, "has only the initial guess of T_lidar_camera", "Run its program `calibrate` to the end")
    raise InputError(path, f"has no extrinsics of a scanner (its keys: {_listed(tree)})", remedy)


def _kalibr(tree: Tree, size: tuple[int, int]) -> Iterator[CalibratedCamera]:
    for name, entry in _kalibr_entries(tree):
        with _about(name):
            camera = _checked(_kalibr_camera(entry))
        yield CalibratedCamera((name, str(entry.get("rostopic", name))), camera)


def _kalibr_camera(entry: Tree) -> Camera:
    model, distortion = str(entry["camera_model"]), str(entry["distortion_model"])
    width, height = _numbers(entry, "resolution", 2).astype(int).tolist()
    D = _numbers(entry, "distortion_coeffs")
    if model in SYMMETRIC_MODELS and not D.any():
        first, second, *intrinsics = _numbers(entry, "intrinsics", 6).tolist()
        radius = partial(SYMMETRIC_MODELS[model], first, second)
        return _symmetric(Camera("fisheye", width, height, *intrinsics), model, radius)
    check_model(model)
    if model != "pinhole":
        raise InvalidCamera(f"has the unknown camera_model {model!r}")
    fx, fy, cx, cy = _numbers(entry, "intrinsics", 4).tolist()
    if distortion == "fov" and len(D) == 1:
        radius = partial(field_of_view_radius, float(D[0]))
        return _symmetric(Camera("fisheye", width, height, fx, fy, cx, cy), distortion, radius)
    lens, coefficients = distortion_of(distortion, D)
    return Camera(lens, width, height, fx, fy, cx, cy, coefficients)


def _symmetric(camera: Camera, model: str, radius: Callable[[F64], F64]) -> Camera:
    """The fisheye camera of a lens that is symmetric about its axis.

    Args:
        camera: size, focal lengths and principal point of the lens.
        model: its name.
        radius: function of angles to the axis (`fit_fisheye`).

    Raises:
        InvalidCamera: a fisheye camera deviates from it.
    """
    _checked(camera)
    edge = max_distorted_radius(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    with np.errstate(all="ignore"):
        slope, k, error = fit_fisheye(radius, edge, max(camera.fx, camera.fy))
    if not (error <= MAX_FIT_ERROR_PX and np.isfinite([slope, *k]).all()):
        raise InvalidCamera(f"has the model {model!r}, from which a fisheye camera deviates by {error:.2f} pixels")
    return replace(camera, fx=camera.fx * slope, fy=camera.fy * slope, distortion=tuple(k.tolist()))


def _kalibr_entries(tree: Tree) -> list[tuple[str, Tree]]:
    """Cameras of a chain of Kalibr by name."""
    keys = {"camera_model", "intrinsics", "distortion_model"}
    tables: list[tuple[str, Tree]] = [(str(name), entry) for name, entry in tree.items() if isinstance(entry, dict)]
    return [(name, entry) for name, entry in tables if keys <= entry.keys()][:MAX_LENGTH]


def _direct_visual(tree: Tree, size: tuple[int, int]) -> Iterator[CalibratedCamera]:
    entry = _table(tree, "camera")
    if not {"camera_model", "intrinsics", "distortion_coeffs"} <= entry.keys():
        return
    topic, model = str(_table(tree, "meta").get("image_topic", "")), str(entry["camera_model"])
    if model == "equirectangular":
        yield CalibratedCamera((topic,), Camera("equirectangular", *size))
        return
    lens, distortion = distortion_of(model, _numbers(entry, "distortion_coeffs"))
    fx, fy, cx, cy = _numbers(entry, "intrinsics", 4).tolist()
    yield CalibratedCamera((topic,), _of_size(Camera(lens, *size, fx, fy, cx, cy, distortion)))


def _fast_livo(tree: Tree, size: tuple[int, int]) -> Iterator[CalibratedCamera]:
    entry = _parameters(tree)
    if "cam_fx" not in entry:
        return
    model = str(entry.get("cam_model"))
    if model.lower() not in LIVO_MODELS:
        raise InvalidCamera(f"has the cam_model {model!r} (known: Pinhole, EquidistantCamera)")
    name, coefficients = LIVO_MODELS[model.lower()]
    D = np.array([_numbers(entry, key, 1)[0] if key in entry else 0.0 for key in coefficients])
    width, height, fx, fy, cx, cy = (
        float(_numbers(entry, f"cam_{name}", 1)[0]) for name in ("width", "height", "fx", "fy", "cx", "cy")
    )
    lens, distortion = distortion_of(name, D)
    yield CalibratedCamera(("camera",), _checked(Camera(lens, int(width), int(height), fx, fy, cx, cy, distortion)))


def _camodocal(tree: Tree, size: tuple[int, int]) -> Iterator[CalibratedCamera]:
    """Camera files of VINS and LVI-SAM."""
    if "model_type" not in tree or "image_width" not in tree:
        return
    check_model((model := str(tree["model_type"])).lower())
    if model not in CAMODOCAL_MODELS:
        raise InvalidCamera(f"has the unknown model_type {model!r}")
    name, table, coefficients, intrinsics = CAMODOCAL_MODELS[model]
    D = np.concatenate([_numbers(_table(tree, table), key, 1) for key in coefficients])
    values = np.concatenate([_numbers(_table(tree, "projection_parameters"), key, 1) for key in intrinsics])
    lens, distortion = distortion_of(name, D)
    fx, fy, cx, cy = values.tolist()
    camera = Camera(lens, _whole(tree, "image_width"), _whole(tree, "image_height"), fx, fy, cx, cy, distortion)
    yield CalibratedCamera((str(tree.get("camera_name", "camera")),), _checked(camera))


def _matrices(tree: Tree, size: tuple[int, int]) -> Iterator[CalibratedCamera]:
    """Files of ROS and OpenCV, which have the same keys, and a CameraInfo that was printed."""
    own = _plain_keys(tree)
    K_key, P_key = _first(own, "cameramatrix", "cameramat", "k"), _first(own, "projectionmatrix", "p")
    if K_key is None:
        return
    stated, roi = _stated_size(own), _table(tree, "roi")
    width, height = stated or size
    model, D = _distortion(own)
    info = SimpleNamespace(
        k=_camera_matrix(own, K_key), d=D, p=_numbers(own, P_key, 12) if P_key else np.zeros(12),
        distortion_model=model, width=width, height=height,
        roi=SimpleNamespace(**{name: _whole(roi, name) for name in ("x_offset", "y_offset", "width", "height")}),
        binning_x=_whole(tree, "binning_x"), binning_y=_whole(tree, "binning_y"),
    )  # fmt: skip
    camera = _checked(camera_of(info, rectified=False))
    rectified = _checked(camera_of(info, rectified=True)) if info.p[0] > 0 else None
    yield CalibratedCamera((str(own.get("cameraname", "camera")),), camera if stated else _of_size(camera), rectified)


def _camera_matrix(own: Tree, key: str) -> F64:
    """K by rows (9,): not transposed, as MATLAB has it, and without skew."""
    K = _numbers(own, key, 9)
    if np.abs(K[[3, 6, 7]]).max() > 0 or K[8] != 1:
        raise InvalidCamera(f"its camera matrix is {K.tolist()}, not fx 0 cx, 0 fy cy, 0 0 1 by rows")
    if abs(K[1]) > MAX_SKEW_PX:
        raise InvalidCamera(f"has a skew of {K[1]:g} pixels, which no camera here has: calibrate it without")
    return K


def _distortion(own: Tree) -> tuple[str, F64]:
    """Name of the distortion model ("": that of OpenCV's perspective lenses) and coefficients (N,)."""
    key = _first(own, "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "d")
    if key is None:
        raise InvalidCamera("has a camera matrix, but no distortion coefficients")
    D, model = _numbers(own, key), str(own.get("distortionmodel", own.get("cameramodel", "")))
    if "fisheyemodel" in own:
        return "fisheye" if _whole(own, "fisheyemodel") else "", D
    if not model and len(D) == 4 and D.any():
        raise InvalidCamera(
            "has four distortion coefficients without a model: add the line `distortion_model: plumb_bob` to it, or "
            "`equidistant` if they are of cv2.fisheye"
        )
    return model, D


def _first(own: Tree, *keys: str) -> str | None:
    return next((key for key in keys if key in own), None)


def _stated_size(own: Tree) -> tuple[int, int] | None:
    """Width and height of a calibration's images, None if it doesn't state them."""
    if "imagesize" in own:
        width, height = _numbers(own, "imagesize", 2).astype(int).tolist()
        return width, height
    for names in (("imagewidth", "imageheight"), ("width", "height")):
        if set(names) <= own.keys():
            width, height = (int(_numbers(own, name, 1)[0]) for name in names)
            return width, height
    return None


def _livo_extrinsics(tree: Tree) -> Tree:
    """The table of a FAST-LIVO's configuration that has the extrinsics of the camera; its name differs."""
    tables = (entry for entry in _parameters(tree).values() if isinstance(entry, dict))
    return next((entry for entry in tables if {"Rcl", "Pcl"} <= entry.keys()), {})


def _parameters(tree: Tree) -> Tree:
    """Parameters of a node: in ROS 2, they are in tables of their own."""
    nested = _table(_table(tree, "/**"), "ros__parameters")
    return nested or tree


def _checked(camera: Camera) -> Camera:
    """A camera with plausible numbers.

    Raises:
        InvalidCamera: size or focal lengths aren't positive.
    """
    if min(camera.width, camera.height) < 1 or min(camera.fx, camera.fy) <= 0:
        size = f"{camera.width}x{camera.height}"
        raise InvalidCamera(f"is not calibrated (size {size}, focal lengths {camera.fx:g}, {camera.fy:g})")
    return camera


def _of_size(camera: Camera) -> Camera:
    """The camera, if its principal point is near the middle of images of its size, which the file doesn't state.

    Raises:
        InvalidCamera: it isn't.
    """
    across, down = camera.cx / camera.width - 0.5, camera.cy / camera.height - 0.5
    if max(abs(across), abs(down)) > MAX_OFF_CENTRE:
        raise InvalidCamera(
            f"doesn't state the size of its images, and its principal point ({camera.cx:g}, {camera.cy:g}) isn't near "
            f"the middle of {camera.width}x{camera.height}: the photos were scaled or cropped after the calibration"
        )
    return _checked(camera)


@contextmanager
def _about(name: str) -> Iterator[None]:
    """Name the camera in errors."""
    try:
        yield
    except InvalidCamera as error:
        raise InvalidCamera(f"camera {name!r} {error}") from None


def _tree(path: Path) -> Tree:
    """Content of a file: YAML, of which JSON is a part, or OpenCV's XML.

    OpenCV's FileStorage isn't used: it allocates matrices of the size that a damaged file states.

    Raises:
        InputError: it can't be read, or is no table.
    """
    if file_checks.check(path).stat().st_size > MAX_BYTES:
        raise InputError(path, f"has more than {MAX_BYTES:,} bytes, too many for a calibration", REMEDY)
    if path.suffix.lower() == ".xml":
        tree: Any = _element(xml.root(path))
    else:
        import yaml

        text = re.sub(r"!!opencv-[\w-]+", "", path.read_text(encoding="utf-8-sig", errors="replace"))  # its matrices
        if text.startswith("%YAML"):  # OpenCV's %YAML:1.0 isn't YAML's directive
            text = text.partition("\n")[2]
        try:
            tree = next(iter(yaml.safe_load_all(text)), None)
        except Exception as error:  # damaged tags raise any error, not only those of YAML
            raise InputError(path, f"is not valid YAML ({' '.join(str(error).split())[:200]})", REMEDY) from None
    if not isinstance(tree, dict):
        raise InputError(path, f"is not {KNOWN}", REMEDY)
    return {str(key): value for key, value in tree.items()}


def _element(element: Any, depth: int = 0) -> Any:
    """Content of an element of OpenCV's XML: a table of its children, or its text."""
    if not len(element) or depth > 5:
        return (element.text or "").strip()
    return {child.tag: _element(child, depth + 1) for child in element}


def _plain_keys(tree: Tree) -> Tree:
    """A table by keys in lower case and without underscores, which programs write in all ways."""
    return {key.lower().replace("_", ""): value for key, value in tree.items()}


def _table(tree: Tree, key: str) -> Tree:
    value = tree.get(key)
    return value if isinstance(value, dict) else {}


def _listed(tree: Tree) -> str:
    return ", ".join(list(tree)[:10]) or "none"


def _numbers(tree: Tree, key: str, size: int | None = None) -> F64:
    """Numbers of an entry: a number, a list, rows, a matrix (`data`), or text with blanks between them (XML).

    Raises:
        InvalidCamera: there are none, another number than `size`, or not finite.
    """
    value: Any = tree.get(key)
    value = value.get("data") if isinstance(value, dict) else value
    value = value.split() if isinstance(value, str) else value
    rows = value if isinstance(value, list) else [value]
    try:
        if len(rows) > MAX_LENGTH or any(isinstance(row, list) and len(row) > MAX_LENGTH for row in rows):
            raise ValueError("too long")
        numbers = np.array([float(x) for row in rows for x in (row if isinstance(row, list) else [row])], np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InvalidCamera(f"`{key}` is missing, or not a list of numbers") from None
    if size is not None and len(numbers) != size:
        raise InvalidCamera(f"`{key}` has {len(numbers)} numbers, expected {size}")
    if not np.isfinite(numbers).all():
        raise InvalidCamera(f"`{key}` contains NaN or infinity")
    return numbers


def _whole(tree: Tree, key: str) -> int:
    return int(_numbers(tree, key, 1)[0]) if key in tree else 0


def _pose(values: F64) -> F64:
    """Transform (4, 4) of x y z qx qy qz qw (7,).

    Raises:
        InvalidCamera: not a unit quaternion.
    """
    from scipy.spatial.transform import Rotation

    if abs(np.linalg.norm(values[3:]) - 1) > 1e-3:
        raise InvalidCamera("its quaternion hasn't the length 1")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
    return T
