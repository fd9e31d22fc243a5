"""Video of tracked features: content, layout, interrupted recordings."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.types import Camera
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.odometry.video_odometry import track
from scan2sim.slam.tracking_video import INLIER_BGR, MAX_WIDTH_PX, PATH_BGR, UNSURE_BGR, Recorder
from scan2sim.slam.video import open_video
from tests.fakes.slam_drive import Follower, drive, gps_of, scatter
from tests.present import present
from tests.slam.conftest import FPS, Drive


def count_pixels(picture: np.ndarray, colour: tuple[int, int, int] | np.ndarray) -> int:
    """Number of pixels (BGR) with approximately a colour."""
    return int((np.abs(picture.astype(int) - np.asarray(colour)).max(axis=-1) < 30).sum())


def frames_of(file: Path) -> list[np.ndarray]:
    with av.open(str(file)) as container:
        return [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]


def test_video_shows_features_and_path(corridor: Drive, tmp_path: Path) -> None:
    file, parts = tmp_path / "sub" / "view.mp4", []
    with Recorder(file, FPS) as recorder:

        def watch(odometry: Odometry, grey: np.ndarray) -> None:
            recorder(odometry, grey)
            parts.append(sorted(p.name for p in file.parent.iterdir()))

        track(
            open_video(corridor.folder / "video.mp4"),
            lambda warn: Odometry(corridor.camera, OdometryParams(), warn=warn),
            watch=watch,
        )
        assert parts[-1] == ["view.part.mp4"]
    assert [p.name for p in file.parent.iterdir()] == ["view.mp4"]
    shown = frames_of(file)
    assert len(shown) == len(corridor.truth) // 2  # every other frame is enough
    height, width = shown[-1].shape[:2]
    assert width <= MAX_WIDTH_PX and height % 2 == 0 and width % 2 == 0
    frame, ground = shown[-1][: width // 2], shown[-1][width // 2 :]
    assert count_pixels(frame, INLIER_BGR) > 100 and count_pixels(frame, (0, 230, 250)) > 30
    assert count_pixels(ground, PATH_BGR) > 100 and count_pixels(ground, UNSURE_BGR) == 0
    grey = shown[0][: width // 2].mean(axis=-1)[60:]
    assert (
        np.corrcoef(grey[::16, ::16].ravel(), enlarged(corridor.greys[0], width)[60:][::16, ::16].ravel())[0, 1] > 0.8
    )
    with av.open(str(file)) as container:
        assert float(present(container.duration) / av.time_base) == pytest.approx(corridor.truth.times[-1], abs=0.4)


def enlarged(grey: np.ndarray, width: int) -> np.ndarray:
    return cv2.resize(grey, (width, width // 2))


@pytest.fixture(scope="module")
def lost() -> tuple[Odometry, list[np.ndarray]]:
    """A drive with black frames: odometry, and images of the recorder at every second frame."""
    times, poses = drive(12)

    def black(frame: int, points: np.ndarray) -> np.ndarray:
        return np.full(len(points), 7 <= times[frame] < 8.5)

    gps = gps_of(times, poses, sigma=0.2)
    follower = Follower(poses, scatter(poses), hide=black)
    odometry = Odometry(Camera("equirectangular", 2048, 1024), OdometryParams(), tracker=follower, gps=gps)
    recorder, pictures = Recorder(Path("nowhere.mp4"), 10.0), []
    for i, time in enumerate(times):
        odometry.add(float(time), np.zeros((4, 8), np.uint8))
        if i % 2 == 0:
            pictures.append(recorder.draw(odometry, np.zeros((4, 8), np.uint8)).copy())
    return odometry, pictures


def test_tracking_loss_is_shown_over_the_frame_and_in_red_on_the_map(lost: tuple[Odometry, list[np.ndarray]]) -> None:
    _, pictures = lost
    top = pictures[0].shape[1] // 2
    assert count_pixels(pictures[30][:top], UNSURE_BGR) == 0 and count_pixels(pictures[30][top:], UNSURE_BGR) == 0
    assert count_pixels(pictures[38][:top], UNSURE_BGR) > 50  # message over the frame
    assert count_pixels(pictures[-1][:top], UNSURE_BGR) == 0 and count_pixels(pictures[-1][top:], UNSURE_BGR) > 20


def test_recording_can_start_at_any_frame(lost: tuple[Odometry, list[np.ndarray]]) -> None:
    odometry, pictures = lost
    late = Recorder(Path("nowhere.mp4"), 10.0).draw(odometry, np.zeros((4, 8), np.uint8))
    top = late.shape[1] // 2
    assert count_pixels(late[top:], PATH_BGR) > 0.8 * count_pixels(pictures[-1][top:], PATH_BGR)
    assert count_pixels(late[top:], UNSURE_BGR) > 0.8 * count_pixels(pictures[-1][top:], UNSURE_BGR)


@pytest.mark.parametrize(
    ("size", "beside"), [((640, 480), True), ((480, 640), True), ((1242, 375), False), ((1920, 1080), False)]
)
def test_layout_depends_on_the_aspect_ratio_of_the_frame(size: tuple[int, int], beside: bool) -> None:
    camera = Camera("pinhole", *size, 500.0, 500.0, size[0] / 2, size[1] / 2)
    odometry = Odometry(camera, OdometryParams())
    grey = np.random.default_rng(0).integers(0, 255, (size[1], size[0]), np.uint8)
    odometry.add(0.0, grey)
    picture = Recorder(Path("nowhere.mp4"), 10.0).draw(odometry, grey)
    height, width = picture.shape[:2]
    assert width <= MAX_WIDTH_PX and height % 2 == 0 == width % 2
    assert (width == MAX_WIDTH_PX and height < 0.6 * MAX_WIDTH_PX) == beside


def test_an_interrupted_recording_can_be_played(corridor: Drive, tmp_path: Path) -> None:
    odometry = Odometry(corridor.camera, OdometryParams())
    recorder = Recorder(tmp_path / "view.mp4", 5.0)
    odometry.add(0.0, corridor.greys[0])
    for _ in range(70):  # several fragments
        recorder(odometry, corridor.greys[0])
    assert len(frames_of(tmp_path / "view.part.mp4")) > 30
    recorder.close()
    recorder.close()
    assert len(frames_of(tmp_path / "view.mp4")) == 70


def test_closing_an_unused_recorder_leaves_no_files(tmp_path: Path) -> None:
    Recorder(tmp_path / "view.mp4", 10.0).close()
    assert not list(tmp_path.iterdir())
