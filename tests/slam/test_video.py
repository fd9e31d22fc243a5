"""Videos as cameras write them: portraits on their side, unstitched panoramas, wide perspective frames."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.camera.panorama import fisheye_pair, whole_sphere
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io.calibration import camera_of_photos
from scan2sim.pipeline.io.images.image import read_levels
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.slam.calibration.camera import camera_of
from scan2sim.slam.reconstruction.photos import Photo, extract_frames, is_panorama
from scan2sim.slam.video import open_video
from tests.slam.conftest import Drive


def fisheyes(grey: U8) -> U8:
    """Two circles of an image (H, 2 H), black around them."""
    height = grey.shape[0]
    y, x = np.mgrid[:height, : 2 * height]
    radius = np.hypot(x % height - (height - 1) / 2, y - (height - 1) / 2)
    return np.where(radius < height / 2, grey, 0).astype(np.uint8)


def perspective(grey: U8) -> U8:
    """A quarter of a panorama, twice as wide as high."""
    height = grey.shape[0]
    part = grey[height // 3 : height // 3 + height // 4, height // 5 : height // 5 + height // 2]
    return np.asarray(cv2.resize(part, (2 * height, height)), np.uint8)


def test_panoramas_fisheye_pairs_and_perspective_frames_are_told_apart(corridor: Drive) -> None:
    for grey in corridor.greys[::5]:
        assert whole_sphere(grey) and not fisheye_pair(grey)
        assert fisheye_pair(fisheyes(grey))
        assert not whole_sphere(perspective(grey)) and not fisheye_pair(perspective(grey))
    night = np.zeros((128, 256), np.uint8)
    assert whole_sphere(night) and not fisheye_pair(night)


def test_camera_of_wide_frames_is_only_assumed_if_they_show_the_whole_sphere(corridor: Drive, tmp_path: Path) -> None:
    for name, grey in (("sphere", corridor.greys[0]), ("wide", perspective(corridor.greys[0]))):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0.png"), grey)
    for camera in (
        camera_of(open_video(tmp_path / "sphere"), "auto", None, None),
        camera_of_photos(tmp_path / "sphere"),
    ):
        assert camera is not None and camera.model == "equirectangular"
    with pytest.raises(InputError, match=r"edges don't meet.*--camera pinhole"):
        camera_of(open_video(tmp_path / "wide"), "auto", None, None)
    with pytest.raises(InputError, match=r"edges don't meet.*--camera pinhole"):
        camera_of_photos(tmp_path / "wide")
    cv2.imwrite(str(tmp_path / "wide" / "0.png"), fisheyes(corridor.greys[0]))
    with pytest.raises(InputError, match=r"two fisheye circles.*Export a 360"):
        camera_of(open_video(tmp_path / "wide"), "auto", None, None)
    chosen = camera_of(open_video(tmp_path / "wide"), "equirectangular", None, None)
    assert chosen is not None and chosen.model == "equirectangular"


def test_photos_are_panoramas_if_they_show_the_whole_sphere(corridor: Drive, tmp_path: Path) -> None:
    path = tmp_path / "0.png"
    cv2.imwrite(str(path), corridor.greys[0])
    assert is_panorama(path, Photo("0.png", 256, 128)) and not is_panorama(path, Photo("0.png", 256, 128, focal=200.0))
    cv2.imwrite(str(path), perspective(corridor.greys[0]))
    assert not is_panorama(path, Photo("0.png", 256, 128))
    cv2.imwrite(str(path), fisheyes(corridor.greys[0]))
    with pytest.raises(InputError, match="fisheye circles"):
        is_panorama(path, Photo("0.png", 256, 128))


@pytest.mark.parametrize("name", ["VID_0001.insv", "GS010001.360"])
def test_unstitched_recordings_are_an_error_with_advice(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"any")
    with pytest.raises(InputError, match=r"unstitched recording of a 360 camera.*Export a 360"):
        open_video(tmp_path / name)


@pytest.mark.parametrize(("turns", "cosine", "sine"), [(1, 0, 1), (2, -1, 0), (3, 0, -1)])
def test_portrait_videos_are_read_upright(turns: int, cosine: int, sine: int, tmp_path: Path) -> None:
    shown = np.full((64, 48), 30, np.uint8)
    shown[:32, :24] = 220  # bright at the top left, as a player shows it
    path = tmp_path / "phone.mp4"
    stored = np.rot90(shown, turns)  # turned clockwise by as many quarters, it is upright again
    height, width = stored.shape
    with Encoder(path, (width, height), 10, preset="ultrafast", crf="10") as encoder:
        for i in range(4):
            encoder.add(np.concatenate([stored, np.full((height // 2, width), 128, np.uint8)]), i / 10)
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40  # ISO/IEC 14496-12, version 0: {a, b, u, c, d, v, x, y, w} in 16.16 and 2.30
    one = 1 << 16
    data[matrix : matrix + 36] = struct.pack(
        ">9i", cosine * one, sine * one, 0, -sine * one, cosine * one, 0, 0, 0, 1 << 30
    )
    path.write_bytes(data)
    video = open_video(path)
    assert (video.width, video.height) == (48, 64)
    assert ((video.first_grey() > 128) == (shown > 128)).mean() > 0.98
    said: list[str] = []
    photos = extract_frames(video, tmp_path / "frames", 10, 0, silent, said.append)
    assert [(photo.width, photo.height) for photo in photos] == [(48, 64)] * 4 and not said
    assert ((read_levels(tmp_path / "frames" / "000000.jpg") > 128) == (shown > 128)).mean() > 0.98
