"""Calibrations of other programs: cameras project as those programs do, extrinsics have their direction."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from scan2sim.flows.pipelines.sweeps import Sweeps
from scan2sim.pipeline.camera.models import project_exactly
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.io.calibration import camera_of_photos, read_camera, read_extrinsics

SIZE = 640, 480
F, C = (401.5, 403.25), (322.75, 236.5)
K = np.array([[F[0], 0, C[0]], [0, F[1], C[1]], [0, 0, 1]])
BROWN, RATIONAL = [-0.21, 0.06, 1e-3, -2e-3, 0.012], [0.3, -0.1, 1e-3, 2e-3, 0.01, 0.5, -0.05, 0.02]
EQUIDISTANT = [0.02, -0.01, 3e-3, -1e-3]
POINTS = np.random.default_rng(0).uniform([-1.5, -1, 2], [1.5, 1, 4], (40, 3))
T_LIDAR_CAMERA = np.eye(4)
T_LIDAR_CAMERA[:3, :3] = (
    np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ Rotation.from_rotvec([0.2, 0.3, -0.1]).as_matrix()
)
T_LIDAR_CAMERA[:3, 3] = 0.3, -0.1, 0.25


def brown(points: F64, D: list[float]) -> F64:
    """Pixels by OpenCV's model of perspective lenses."""
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(D))[0].reshape(-1, 2)


def fisheye(points: F64, D: list[float]) -> F64:
    """Pixels by OpenCV's model of fisheye lenses."""
    return cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, np.array(D))[0].reshape(-1, 2)


def radtan(points: F64, D: list[float]) -> F64:
    """Pixels as Kalibr computes them (aslam_cv's RadialTangentialDistortion)."""
    (k1, k2, p1, p2), (x, y) = D, (points[:, :2] / points[:, 2:]).T
    r2 = x * x + y * y
    radial = k1 * r2 + k2 * r2 * r2
    u = x + x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y + y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    return np.stack([F[0] * u + C[0], F[1] * v + C[1]], axis=1)


def save(path: Path, content: Any) -> Path:
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content), encoding="utf-8")
    return path


def agrees(camera: Camera, expected: F64, points: F64 = POINTS) -> bool:
    """Whether a camera projects points to the expected pixels, to a millionth."""
    uv, valid = project_exactly(camera, points)
    return bool(valid.all() and (camera.width, camera.height) == SIZE and np.abs(uv - expected).max() < 1e-6)


def kalibr(model: str = "radtan", D: list[float] = BROWN[:4], **more: Any) -> dict[str, Any]:
    """A camera of a camchain.yaml."""
    return {
        "camera_model": "pinhole", "intrinsics": [*F, *C], "distortion_model": model, "distortion_coeffs": D,
        "resolution": list(SIZE), "rostopic": "/cam0/image_raw", "T_cam_imu": np.eye(4).tolist(), "cam_overlaps": [],
        "timeshift_cam_imu": -0.0058,
    } | more  # fmt: skip


def matrix(rows: int, values: Any) -> dict[str, Any]:
    flat = np.ravel(values).tolist()
    return {"rows": rows, "cols": len(flat) // rows, "data": flat}


def ros(model: str | None = "plumb_bob", D: list[float] = BROWN, **more: Any) -> dict[str, Any]:
    """A file of the package camera_calibration."""
    P = [350.0, 0, 330, 0, 0, 350, 250, 0, 0, 0, 1, 0]
    return {
        "image_width": SIZE[0], "image_height": SIZE[1], "camera_name": "front", "camera_matrix": matrix(3, K),
        **({} if model is None else {"distortion_model": model}), "distortion_coefficients": matrix(1, D),
        "rectification_matrix": matrix(3, np.eye(3)), "projection_matrix": matrix(3, P),
    } | more  # fmt: skip


def visual(model: str = "plumb_bob", D: list[float] = BROWN, intrinsics: Any = (*F, *C)) -> dict[str, Any]:
    """A calib.json of direct_visual_lidar_calibration."""
    pose = [*T_LIDAR_CAMERA[:3, 3], *Rotation.from_matrix(T_LIDAR_CAMERA[:3, :3]).as_quat()]
    return {
        "camera": {"camera_model": model, "distortion_coeffs": D, "intrinsics": list(intrinsics)},
        "meta": {"image_topic": "/front/image_raw"},
        "results": {"T_lidar_camera": list(map(float, pose)), "init_T_lidar_camera": [0, 0, 0, 0, 0, 0, 1]},
    }


def vins(model: str, D: dict[str, float]) -> dict[str, Any]:
    """A camera file of VINS."""
    names = ("fx", "fy", "cx", "cy") if model == "PINHOLE" else ("mu", "mv", "u0", "v0")
    intrinsics = dict(zip(names, (*F, *C), strict=True))
    lens = {"distortion_parameters": D} if model == "PINHOLE" else {}
    size = {"image_width": SIZE[0], "image_height": SIZE[1]}
    return {"model_type": model, **size, **lens, "projection_parameters": intrinsics | ({} if lens else D)}


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"cam0": kalibr()}, radtan(POINTS, BROWN[:4])),
        ({"cam0": kalibr("equidistant", EQUIDISTANT)}, fisheye(POINTS, EQUIDISTANT)),
        ({"cam0": kalibr("none", [])}, radtan(POINTS, [0.0] * 4)),
        (ros(), brown(POINTS, BROWN)),
        (ros("rational_polynomial", RATIONAL), brown(POINTS, RATIONAL)),
        (ros("equidistant", EQUIDISTANT), fisheye(POINTS, EQUIDISTANT)),
        (ros(None), brown(POINTS, BROWN)),
        (ros(None, camera_model="fisheye", D=EQUIDISTANT), fisheye(POINTS, EQUIDISTANT)),
        (ros(distortion_coefficients=BROWN), brown(POINTS, BROWN)),
        (vins("PINHOLE", dict(zip(("k1", "k2", "p1", "p2"), BROWN, strict=False))), brown(POINTS, BROWN[:4])),
        (
            vins("KANNALA_BRANDT", dict(zip(("k2", "k3", "k4", "k5"), EQUIDISTANT, strict=True))),
            fisheye(POINTS, EQUIDISTANT),
        ),
        (visual(), brown(POINTS, BROWN)),
        (visual("fisheye", EQUIDISTANT), fisheye(POINTS, EQUIDISTANT)),
    ],
)
def test_cameras_project_as_in_the_program_that_calibrated_them(tmp_path: Path, content: Any, expected: F64) -> None:
    assert agrees(read_camera(save(tmp_path / "calibration.yaml", content), *SIZE), expected)
    (tmp_path / "calibration.json").write_text(json.dumps(content, indent=2), encoding="utf-8")
    assert agrees(read_camera(tmp_path / "calibration.json", *SIZE), expected)


def double_sphere(p: F64) -> F64:
    """Pixels as Kalibr computes them, relative to the focal lengths and the centre."""
    d, xi, alpha = np.linalg.norm(p, axis=1), -0.2, 0.59
    k = xi * d + p[:, 2]
    return p[:, :2] / (alpha * np.sqrt(p[:, 0] ** 2 + p[:, 1] ** 2 + k * k) + (1 - alpha) * k)[:, None]


def extended_unified(p: F64) -> F64:
    alpha, beta = 0.61, 1.05
    d = np.sqrt(beta * (p[:, 0] ** 2 + p[:, 1] ** 2) + p[:, 2] ** 2)
    return p[:, :2] / (alpha * d + (1 - alpha) * p[:, 2])[:, None]


def field_of_view(p: F64) -> F64:
    y, w = p[:, :2] / p[:, 2:], 0.92
    r = np.linalg.norm(y, axis=1)[:, None]
    return y * np.arctan(2 * np.tan(w / 2) * r) / (r * w)


@pytest.mark.parametrize(
    ("chain", "model", "widest_deg"),
    [
        (kalibr("none", [], camera_model="ds", intrinsics=[-0.2, 0.59, *F, *C]), double_sphere, 100),
        (kalibr("none", [], camera_model="eucm", intrinsics=[0.61, 1.05, *F, *C]), extended_unified, 100),
        (kalibr("fov", [0.92]), field_of_view, 75),
    ],
)
def test_symmetric_lenses_become_fisheye_cameras_that_agree_to_a_twentieth_of_a_pixel(
    tmp_path: Path, chain: dict[str, Any], model: Any, widest_deg: float
) -> None:
    angle, azimuth = np.random.default_rng(0).uniform([0.01, 0], [np.radians(widest_deg), 6.28], (2000, 2)).T
    rays = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=1)
    expected = model(rays) * F + C
    seen = ((expected > 0) & (expected < SIZE)).all(axis=1)
    uv, valid = project_exactly(read_camera(save(tmp_path / "chain.yaml", {"cam0": chain}), *SIZE), rays)
    assert seen.sum() > 500 and valid[seen].all() and np.abs(uv - expected)[seen].max() < 0.05


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
@pytest.mark.parametrize("wide", [False, True])
def test_files_that_opencv_writes_are_read(tmp_path: Path, suffix: str, wide: bool) -> None:
    D = EQUIDISTANT if wide else BROWN
    file = cv2.FileStorage(str(tmp_path / f"camera{suffix}"), cv2.FILE_STORAGE_WRITE)
    file.write("calibration_time", "Mon Nov 30 10:00:00 2026")
    for name, value in zip(("image_width", "image_height", "fisheye_model"), (*SIZE, int(wide)), strict=True):
        file.write(name, value)
    file.write("camera_matrix", K)
    file.write("distortion_coefficients", np.array(D)[:, None])
    file.release()
    expected = fisheye(POINTS, D) if wide else brown(POINTS, D)
    assert agrees(read_camera(tmp_path / f"camera{suffix}", *SIZE), expected)


def test_printed_camera_info_has_region_of_interest_and_binning(tmp_path: Path) -> None:
    """`rostopic echo` prints K, D, P and separates messages by lines of three dashes."""
    roi = {"x_offset": 40, "y_offset": 20, "width": 1280, "height": 960, "do_rectify": False}
    K2 = np.array([[2 * F[0], 0, 2 * C[0] + 40.5], [0, 2 * F[1], 2 * C[1] + 20.5], [0, 0, 1]])
    one = {
        "height": 1000,
        "width": 1400,
        "distortion_model": "plumb_bob",
        "D": BROWN,
        "K": K2.ravel().tolist(),
        "roi": roi,
    }
    text = yaml.safe_dump(one | {"P": [0.0] * 12, "binning_x": 2, "binning_y": 2})
    camera = read_camera(save(tmp_path / "info.yaml", f"{text}---\n{text}---\n"), *SIZE)
    assert agrees(camera, brown(POINTS, BROWN))


def test_extrinsics_of_direct_visual_lidar_calibration_project_points_of_the_lidar(tmp_path: Path) -> None:
    """p_lidar = T_lidar_camera p_camera, by its documentation."""
    file = save(tmp_path / "calib.json", json.dumps(visual()))
    in_lidar = POINTS @ T_LIDAR_CAMERA[:3, :3].T + T_LIDAR_CAMERA[:3, 3]
    T = read_extrinsics(file)
    assert agrees(read_camera(file, *SIZE), brown(POINTS, BROWN), in_lidar @ T[:3, :3].T + T[:3, 3])
    sphere = save(tmp_path / "sphere.json", json.dumps(visual("equirectangular", [], (512, 256))))
    assert read_camera(sphere, 512, 256) == Camera("equirectangular", 512, 256)
    only_guess = visual()
    del only_guess["results"]["T_lidar_camera"]
    with pytest.raises(InputError, match="only the initial guess of T_lidar_camera"):
        read_extrinsics(save(file, only_guess))


def test_autoware_has_the_camera_in_the_lidar_and_fast_livo_the_lidar_in_the_camera(tmp_path: Path) -> None:
    expected = np.linalg.inv(T_LIDAR_CAMERA)
    file = cv2.FileStorage(str(tmp_path / "autoware.yaml"), cv2.FILE_STORAGE_WRITE)
    values = {"CameraExtrinsicMat": T_LIDAR_CAMERA, "CameraMat": K, "DistCoeff": np.array([BROWN])}
    for name, value in values.items():
        file.write(name, value)
    file.write("ImageSize", np.array(SIZE, float))
    file.release()
    assert np.allclose(read_extrinsics(tmp_path / "autoware.yaml"), expected, atol=1e-9)
    assert agrees(read_camera(tmp_path / "autoware.yaml", *SIZE), brown(POINTS, BROWN))
    livo = {"Rcl": expected[:3, :3].ravel().tolist(), "Pcl": expected[:3, 3].tolist(), "extrinsic_T": [1, 2, 3]}
    lens = {"cam_width": 640, "cam_height": 480, "cam_fx": F[0], "cam_fy": F[1], "cam_cx": C[0], "cam_cy": C[1]}
    lens |= {f"cam_d{i}": BROWN[i] for i in range(4)}
    parameters = {"extrin_calib": livo, "cam_model": "Pinhole", **lens}
    for content in (parameters, {"/**": {"ros__parameters": parameters}}):
        path = save(tmp_path / "livo.yaml", content)
        assert np.allclose(read_extrinsics(path), expected, atol=1e-9)
        assert agrees(read_camera(path, *SIZE), brown(POINTS, BROWN[:4]))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"cam0": kalibr(camera_model="omni")}, r"'cam0' has the model 'omni' \(Mei.*no counterpart.*pinhole-equi"),
        ({"cam0": kalibr(camera_model="ds")}, r"'ds' \(the double sphere model\)"),
        ({"cam0": kalibr("fov", [0.9, 0.1])}, r"'fov' \(the field of view model\)"),
        ({"cam0": kalibr("fov", [3.0])}, "'fov', from which a fisheye camera deviates by"),
        ({"cam0": kalibr("none", [], camera_model="ds", intrinsics=[-3, 0.1, *F, *C])}, "'ds'.*deviates by inf"),
        ({"cam0": kalibr("radtan", BROWN[:3])}, "has 3 coefficients of the model 'radtan'"),
        ({"cam0": kalibr(intrinsics=[400, 320, 240])}, "`intrinsics` has 3 numbers, expected 4"),
        ({"cam0": kalibr(resolution=[1280, 960])}, r"640x480 \(it has 1280x960\).*focal = \[200\.750, 201\.625\]"),
        ({"cam0": kalibr(resolution=[480, 640])}, r"no camera of 640x480 \(it has 480x640\). Write"),
        (visual("omnidir", BROWN), r"'omnidir' \(Mei"),
        (visual(intrinsics=(803.0, 803, 640, 480)), "doesn't state the size.*principal point.*scaled or cropped"),
        (ros(camera_matrix=matrix(3, K.T)), "not fx 0 cx, 0 fy cy, 0 0 1 by rows"),
        (ros(camera_matrix=matrix(3, K + [[0, 2, 0], [0, 0, 0], [0, 0, 0]])), "skew of 2 pixels"),
        (ros(None, EQUIDISTANT), "four distortion coefficients without a model.*cv2.fisheye"),
        (ros(D=[0.1] * 12), "has 12 coefficients"),
        ({k: v for k, v in ros().items() if "coefficients" not in k}, "but no distortion coefficients"),
        (ros(camera_matrix=matrix(3, K * np.nan)), "`cameramatrix` contains NaN"),
        (ros(image_width=0), "is not calibrated"),
        (ros(camera_matrix=matrix(3, K * [[1e9, 1, 1]] * [[1], [1], [1]])), "exceeds 1,000,000"),
        ({"model_kind": "PINHOLE", "projection_parameters": {}}, r"is not a calibration.*its keys: model_kind"),
        (vins("MEI", {}), r"has the model 'mei' \(Mei"),
        (vins("PINHOLE", {"k1": 0.1}), "`k2` is missing"),
        ("- 1\n- 2\n", "is not a calibration of Kalibr"),
        ("a: [1, 2\n", "is not valid YAML"),
        ("a: !!python/object:os.system x\n", "is not valid YAML"),
        ("camera_matrix: [[[1]]]\nD: []\n", "`cameramatrix` is missing, or not a list of numbers"),
        ("", "is not a calibration"),
    ],
)  # fmt: skip
def test_unusable_calibrations_are_rejected_with_cause_and_remedy(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_camera(save(tmp_path / "camera.yaml", content), *SIZE)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"cam0": kalibr()}, "cameras' poses in the IMU's axes, and no scanner"),
        (ros(), "no extrinsics of a scanner.*T_camera_scanner in a text file"),
        (visual() | {"results": {"T_lidar_camera": [0, 0, 0, 1, 1, 1, 1]}}, "quaternion hasn't the length 1"),
        ({"extrin_calib": {"Rcl": (2 * np.eye(3)).ravel().tolist(), "Pcl": [0, 0, 0]}}, "not a rotation matrix"),
        ({"CameraExtrinsicMat": [0.0] * 16}, "not a rigid transform"),
    ],
)
def test_files_without_extrinsics_of_a_scanner_are_rejected(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_extrinsics(save(tmp_path / "calibration.yaml", content))


def test_several_cameras_of_one_size_are_told_apart_by_name(tmp_path: Path) -> None:
    right = kalibr(intrinsics=[500.0, 500.0, 320.0, 240.0], rostopic="/cam1/image_raw", T_cn_cnm1=np.eye(4).tolist())
    chain = save(tmp_path / "camchain.yaml", {"cam0": kalibr(), "cam1": right})
    assert (
        read_camera(chain, *SIZE, names=("cam1",)).fx == read_camera(chain, *SIZE, names=("/cam1/image_raw",)).fx == 500
    )
    with pytest.raises(InputError, match=r"several cameras of 640x480 \(cam0, cam1\).*the id rear"):
        read_camera(chain, *SIZE, names=("rear",))
    photos = tmp_path / "cam1"
    photos.mkdir()
    cv2.imwrite(str(photos / "0.png"), np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    assert camera_of_photos(photos, file=chain).fx == 500
    with pytest.raises(SettingError, match=r"--focal.* beside a file"):
        camera_of_photos(photos, file=chain, focal=400.0)
    one = '[[cameras]]\nid = "{}"\nmodel = "pinhole"\nsize = [640, 480]\nfocal = [{}, 400]\ncentre = [320, 240]\n'
    rig = save(tmp_path / "rig.toml", one.format("cam0", 400) + one.format("cam1", 500))
    assert camera_of_photos(photos, file=rig).fx == 500
    with pytest.raises(InputError, match="several cameras"):
        read_camera(rig, *SIZE)


def test_rectified_photos_have_the_camera_of_the_projection_matrix(tmp_path: Path) -> None:
    camera = read_camera(save(tmp_path / "front.yaml", ros()), *SIZE, rectified=True)
    assert camera == Camera("pinhole", *SIZE, 350, 350, 330, 250)
    plain = save(tmp_path / "plain.yaml", {"cam0": kalibr("none", [])})
    assert read_camera(plain, *SIZE, rectified=True) == read_camera(plain, *SIZE)
    with pytest.raises(InputError, match="has the camera of raw images"):
        read_camera(save(tmp_path / "camchain.yaml", {"cam0": kalibr()}), *SIZE, rectified=True)


def test_calibration_beside_a_drive_toml_is_a_file_and_no_model() -> None:
    """Its path is relative to the drive.toml, and not found from elsewhere."""
    sweeps = Sweeps(folder=Path("sweeps"), camera="calibration/camchain.yaml")
    assert sweeps.inputs(Path("/drive"))["camera"] == Path("/drive/calibration/camchain.yaml")
    assert sweeps.params().camera == "auto" and Sweeps(folder=Path("sweeps"), camera="pinhole").camera_file is None
