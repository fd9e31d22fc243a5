"""Unknown or inexact intrinsics: calibrated in a turn, read from EXIF, never guessed."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from scan2sim.pipeline.camera.lens import changed_lens
from scan2sim.pipeline.camera.models import inside, project_exactly
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import Camera
from scan2sim.slam.calibration.calibrate import calibrated, calibrated_from_scratch
from scan2sim.slam.calibration.camera import EstimatedCamera, estimated_camera
from scan2sim.slam.odometry.track_log import TrackLog
from scan2sim.slam.steps.track import TrackContext, TrackParams, video_camera
from scan2sim.slam.video import open_video
from tests.fakes.slam_drive import LENS, drive, scatter
from tests.present import present


def tracks_in_a_turn(camera: Camera, turn: float = 0.3) -> TrackLog:
    """Feature tracks of a camera in a turn."""
    times, poses = drive(7, turn=turn)
    rng, points = np.random.default_rng(0), scatter(poses, 3000)
    out = TrackLog((camera.width, camera.height))
    for time, pose in zip(times, poses, strict=True):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        uv, valid = project_exactly(camera, local)
        rows = np.flatnonzero(valid & inside(camera, uv) & (local[:, 2] > 1) & (np.linalg.norm(local, axis=1) < 40))
        out.times.append(float(time))
        out.ids.append(rows)
        out.uv.append(uv[rows] + rng.normal(0, 0.3, (len(rows), 2)))
    return out


@pytest.mark.slow
def test_unknown_intrinsics_are_calibrated_in_a_turn() -> None:
    cropped = changed_lens(LENS, np.array([0, 0.15, 0, 0, 0]))
    known = present(calibrated_from_scratch(tracks_in_a_turn(cropped)))
    assert abs(known.camera.fx / LENS.fx - 1) < 0.02
    assert abs(known.camera.cx - cropped.cx) < 10


def test_calibration_over_the_whole_drive_suggests_options() -> None:
    known = present(calibrated(tracks_in_a_turn(LENS), changed_lens(LENS, np.array([-0.1, 0, 0, 0, 0]))))
    facts = EstimatedCamera.of(known, "self-calibration").metrics()["lens"]
    assert abs(facts["focal"] - LENS.fx) < 3 * facts["focal_sigma"] < 60
    assert facts["options"].startswith(f"--focal {facts['focal']:.2f} --centre ")


def write_images(folder: Path, focal: int | None) -> Path:
    folder.mkdir()
    for k in range(2):
        picture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8))
        exif = Image.Exif()
        if focal is not None:
            exif.get_ifd(0x8769)[41989] = focal
        picture.save(folder / f"{k}.jpg", exif=exif)
    return folder


def test_focal_length_is_read_from_exif(tmp_path: Path) -> None:
    video = open_video(write_images(tmp_path / "a", focal=28))
    own = present(estimated_camera(video, None, lambda: pytest.fail("not needed"), calibrate=False))
    assert own.camera.fx == pytest.approx(28 / np.hypot(36, 24) * 200) and "EXIF" in own.message()


def test_camera_of_a_video_is_that_of_a_calibration_and_never_a_model_that_does_not_exist(tmp_path: Path) -> None:
    video, chain = open_video(write_images(tmp_path / "left", focal=28)), tmp_path / "camchain.yaml"

    def one(focal: float) -> dict[str, Any]:
        lens = {"distortion_model": "equidistant", "distortion_coeffs": [0.1, 0.02, 0.0, 0.0]}
        return {"camera_model": "pinhole", "intrinsics": [focal, focal, 80, 60], "resolution": [160, 120], **lens}

    chain.write_text(yaml.safe_dump({"left": one(90.0), "right": one(95.0)}), encoding="utf-8")

    def camera(file: Path | None = None, **given: Any) -> Camera:
        params = TrackParams.model_validate(given)
        return video_camera(video, params, lambda: pytest.fail("not needed"), tmp_path / "lens.json", file)[0]

    assert camera(chain) == Camera("fisheye", 160, 120, 90.0, 90.0, 80.0, 60.0, (0.1, 0.02, 0.0, 0.0))
    with pytest.raises(SettingError, match="unknown model 'fisheye'.*or a file"):
        camera(camera="fisheye", focal=500.0)
    for name, given in {"focal": 500.0, "centre": (80.0, 60.0), "k1": 0.1, "k2": 0.0}.items():
        with pytest.raises(SettingError, match=f"--{name}.* beside a file with the camera"):
            camera(chain, **{name: given})
    two = [asdict(Camera("pinhole", 160, 120, focal, focal, 80.0, 60.0)) for focal in (90.0, 95.0)]
    assert camera(context=TrackContext(cameras=tuple(two[:1]))).fx == 90
    with pytest.raises(InputError, match="the tile has several cameras with an image size of 160x120"):
        camera(context=TrackContext(cameras=tuple(two)))


@pytest.mark.parametrize("said", [None, LENS])
def test_calibration_without_a_turn_is_an_error(tmp_path: Path, said: Camera | None) -> None:
    video = open_video(write_images(tmp_path / "a", focal=None))
    with pytest.raises(InputError, match="turns too little"):
        estimated_camera(video, said, lambda: tracks_in_a_turn(LENS, turn=0.0).part(0, 25), calibrate=True)
