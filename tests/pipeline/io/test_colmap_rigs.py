"""COLMAP models with rigs and frames, written by pycolmap: poses are those that pycolmap composes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io.photogrammetry import Photos
from scan2sim.pipeline.io.photogrammetry.colmap import read

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap isn't installed")


def rig_model(seed: int, cameras: int, frames: int) -> Any:
    """A reconstruction of a rig of cameras with random poses; its images aren't all in the order of their ids."""
    random = np.random.default_rng(seed)

    def pose() -> Any:
        return pycolmap.Rigid3d(pycolmap.Rotation3d(random.normal(0, 0.5, 3)), random.normal(0, 3, 3))

    model, camera = pycolmap.Reconstruction(), pycolmap.SensorType.CAMERA
    rig = pycolmap.Rig(rig_id=7)
    for key in range(1, cameras + 1):
        params = [500, 500, 320, 240]
        model.add_camera(pycolmap.Camera(model="PINHOLE", width=640, height=480, params=params, camera_id=key))
        if key == 1:
            rig.add_ref_sensor(pycolmap.sensor_t(camera, key))
        else:
            rig.add_sensor(pycolmap.sensor_t(camera, key), pose())
    model.add_rig(rig)
    keys = iter(random.permutation(cameras * frames) + 1)
    for number in range(1, frames + 1):
        frame = pycolmap.Frame(frame_id=number, rig_id=7)
        frame.rig_from_world = pose()
        images = {key: int(next(keys)) for key in range(1, cameras + 1)}
        for key, image in images.items():
            frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(camera, key), image))
        model.add_frame(frame)
        for key, image in images.items():
            one = pycolmap.Image(name=f"camera{key}/{number}.jpg", camera_id=key, image_id=image)
            one.frame_id = number
            model.add_image(one)
        model.register_frame(number)
    return model


def spoil_images(folder: Path) -> None:
    """Replace the poses in images.txt by one that other programs could have left there."""
    lines = (folder / "images.txt").read_text().splitlines()
    made = [line if line.startswith("#") or not line else _spoiled(line) for line in lines]
    (folder / "images.txt").write_text("\n".join(made) + "\n")


def _spoiled(line: str) -> str:
    words = line.split()
    return " ".join([words[0], "1 0 0 0 0.5 0 0", *words[8:]])


@pytest.mark.parametrize("suffix", ["txt", "bin"])
@pytest.mark.parametrize(("seed", "cameras", "frames"), [(1, 1, 3), (2, 2, 4), (3, 5, 3)])
def test_poses_are_those_of_rigs_and_frames(tmp_path: Path, suffix: str, seed: int, cameras: int, frames: int) -> None:
    model = rig_model(seed, cameras, frames)
    (model.write_text if suffix == "txt" else model.write_binary)(str(tmp_path))
    found = read(tmp_path, Photos(tmp_path))
    assert not found.notes
    if suffix == "txt":
        spoil_images(tmp_path)
        found = read(tmp_path, Photos(tmp_path))
        assert len(found.notes) == 1 and "frames.txt" in found.notes[0]
    truth = {image.name: image.cam_from_world().inverse().matrix() for image in model.images.values()}
    assert {shot.file for shot in found.shots} == set(truth)
    for shot in found.shots:
        assert np.allclose(shot.pose[:3], truth[shot.file], atol=1e-9), shot.file


def test_camera_without_a_pose_in_its_rig_keeps_that_of_its_image(tmp_path: Path) -> None:
    model = rig_model(4, 2, 2)
    model.write_text(str(tmp_path))
    before = {shot.file: shot.pose for shot in read(tmp_path, Photos(tmp_path)).shots}
    text = (tmp_path / "rigs.txt").read_text().splitlines()
    (tmp_path / "rigs.txt").write_text("\n".join([*text[:-1], "7 2 CAMERA 1 CAMERA 2 0"]) + "\n")
    after = {shot.file: shot.pose for shot in read(tmp_path, Photos(tmp_path)).shots}
    assert all(np.allclose(after[name], pose) for name, pose in before.items())


@pytest.mark.parametrize("damage", ["no rigs", "other rig", "cut"])
def test_damaged_rigs_are_named(tmp_path: Path, damage: str) -> None:
    rig_model(5, 2, 2).write_text(str(tmp_path))
    file = tmp_path / "rigs.txt"
    if damage == "no rigs":
        file.unlink()
    else:
        file.write_text("9 2 CAMERA 1 CAMERA 2 0\n" if damage == "other rig" else "7 2 CAMERA 1 CAMERA 2 1 0.5\n")
    with pytest.raises(InputError, match="rigs.txt"):
        read(tmp_path, Photos(tmp_path))
