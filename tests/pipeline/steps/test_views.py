"""Photos that are held out: every Nth moment, with all cameras of a rig."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.types import Camera, View
from scan2sim.pipeline.steps.views import held_out

FRAMES = 24
LEFT, RIGHT = (Camera("pinhole", 64, 48, focal, focal, 31.5, 23.5) for focal in (50.0, 60.0))


def photo(folder: str, frame: int, camera: Camera = LEFT, time: float | None = None, beside: float = 0.0) -> View:
    pose = np.eye(4)
    pose[:3, 3] = 1.5 * frame, beside, 1.6
    return View(f"{folder}/{frame:06d}", camera, pose, Path(folder) / f"{frame:06d}.png", time=time)


def frames_of(views: list[View], folder: str) -> list[int]:
    chosen = (view for view, held in zip(views, held_out(views, 8), strict=True) if held)
    return [int(view.photo.stem) for view in chosen if view.photo.parent.name == folder]


def test_every_8th_photo_of_one_camera() -> None:
    views = [photo("image", frame) for frame in range(FRAMES)]
    assert frames_of(views, "image") == [4, 12, 20]
    assert not any(held_out(views, 0))


@pytest.mark.parametrize("timed", [False, True])
@pytest.mark.parametrize("camera", [LEFT, RIGHT])
def test_twins_of_a_stereo_rig_are_held_out_together(camera: Camera, timed: bool) -> None:
    """Whether their lenses are the same or not; triggers of a rig differ by a millisecond."""
    views = [
        photo(folder, frame, one, frame / 10 + delay if timed else None, beside)
        for frame in range(FRAMES)
        for folder, one, delay, beside in (("left", LEFT, 0.0, 0.0), ("right", camera, 0.001, 0.54))
    ]
    assert frames_of(views, "left") == frames_of(views, "right") == [4, 12, 20]


def test_cameras_that_are_not_synchronized_are_counted_one_after_the_other() -> None:
    views = [photo("left", frame, LEFT, frame / 10) for frame in range(FRAMES)]
    views += [photo("right", frame, RIGHT, frame / 10 + 0.05) for frame in range(FRAMES)]
    assert frames_of(views, "left") == frames_of(views, "right") == [4, 12, 20]


def test_equal_names_at_other_places_are_other_photos() -> None:
    """Folders of stations, each with a photo `000000.png`."""
    views = []
    for station in range(FRAMES):
        one = photo(f"station_{station}", 0)
        one.T_world_cam[0, 3] = 5.0 * station
        views.append(one)
    assert np.flatnonzero(held_out(views, 8)).tolist() == [4, 12, 20]
