"""Check of photos against the cloud: detects common errors, with the option that fixes them, and no others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scan2sim.data_samples.street import generate
from scan2sim.flows.commands.inspect import inspect_path
from scan2sim.pipeline.core.types import Camera, Tile, Trajectory
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.pose_check import check, conventions, photo_fit
from scan2sim.pipeline.pose_check.check import check_photos, find_mistake
from scan2sim.pipeline.pose_check.conventions import PosedPhotos


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street with 40 photos of four cameras."""
    out = tmp_path_factory.mktemp("street") / "tile"
    generate(out, length=40.0, points=200_000, photos=40, seed=5, photo_width=360)
    return out


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photo_fit, "LIMITS", replace(photo_fit.LIMITS, max_points=60_000, photo_width_px=300))


def changed(street: Path, change: Callable[[PosedPhotos], PosedPhotos]) -> Tile:
    """The tile as imported with a mistake."""
    tile = read_tile(street)
    T = np.array([view.T_world_cam for view in tile.views])
    T[:, :3, 3] += tile.frame.origin
    photos = change(PosedPhotos(T, tuple(view.camera for view in tile.views), tile.frame))
    photos.T[:, :3, 3] -= tile.frame.origin
    rows = zip(tile.views, photos.T, photos.cameras, strict=True)
    return replace(tile, views=tuple(replace(v, T_world_cam=T, camera=camera) for v, T, camera in rows))


def for_images_of_another_size(photos: PosedPhotos) -> PosedPhotos:
    """The intrinsics of 360 x 270 pixels for images twice as large, recognizable by the principal points."""
    larger = {id(one): scaled_intrinsics(one) for one in photos.cameras}
    return replace(photos, cameras=tuple(larger[id(camera)] for camera in photos.cameras))


def latitude_as_longitude(photos: PosedPhotos) -> PosedPhotos:
    """Positions in degrees, latitude first, that were read as longitude first."""
    degrees = conventions.swapped_axes(conventions.to_crs(photos, "EPSG:4326"))
    return conventions.from_crs(degrees, "EPSG:4326")


def scaled_intrinsics(c: Camera) -> Camera:
    return replace(c, fx=2 * c.fx, fy=2 * c.fy, cx=2 * c.cx + 0.5, cy=2 * c.cy + 0.5)


def test_no_error_is_reported_for_correct_tiles(street: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert find_mistake(read_tile(street)) is None
    inspect_path(street)
    assert "--" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "option"),
    [
        (conventions.transposed, "--rotations T_cam_world"),
        (lambda photos: photos.rotated(photos.R @ conventions.AXES["opengl"].T), "--camera-axes opengl"),
        (lambda photos: conventions.to_crs(photos, "EPSG:32632"), "--photos-crs EPSG:32632"),
        (lambda photos: conventions.shifted(photos, 1)[0], "--pose-shift -1"),
        (for_images_of_another_size, "--intrinsics-size 720x540"),
        (lambda photos: conventions.reordered_quaternions(photos, -1), "--quaternions xyzw"),
        (lambda photos: photos.at(photos.positions / 0.3048), "--photos-units ft"),
        (latitude_as_longitude, "--position-axes yx"),
    ],
)
def test_pose_conventions_are_detected_with_their_option(
    street: Path, change: Callable[[PosedPhotos], PosedPhotos], option: str
) -> None:
    mistake = find_mistake(changed(street, change))
    assert mistake is not None and mistake.option == option
    assert f"with `{option}` the photos fit" in str(mistake)


def on_path(street: Path) -> Tile:
    """The tile with only the front camera, posed by a scanner path as by `import sweeps`."""
    tile = read_tile(street)
    views = [view for view in tile.views if view.camera is tile.views[0].camera]
    T = np.array([view.T_world_cam for view in views]) @ np.linalg.inv(scanner_camera())
    times = np.arange(len(views), dtype=np.float64) / 2
    views = [replace(view, time=time) for view, time in zip(views, times.tolist(), strict=True)]
    return replace(tile, views=tuple(views), trajectory=Trajectory(times, T[:, :3, 3], T[:, :3, :3]))


def scanner_camera() -> np.ndarray:
    """(4, 4) T_scanner_camera."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = conventions.AXES["ros"], (0.2, 0.1, -0.4)
    return T


def test_wrong_times_and_inverted_extrinsics_are_detected(street: Path) -> None:
    tile = on_path(street)
    path = tile.trajectory
    assert path is not None and find_mistake(tile) is None
    frame = float(np.median(np.diff(path.times)))
    late = path.pose_at([(view.time or 0.0) - frame for view in tile.views]) @ scanner_camera()
    posed = zip(tile.views[1:], late[1:], strict=True)  # the first one is before the path
    views = [replace(view, T_world_cam=T, time=(view.time or 0.0) - frame) for view, T in posed]
    mistake = find_mistake(replace(tile, views=tuple(views)))
    assert mistake is not None and mistake.option == f"--photo-time-offset {frame:g}"
    inverse = path.pose_at([view.time or 0.0 for view in tile.views]) @ np.linalg.inv(scanner_camera())
    views = [replace(v, T_world_cam=T) for v, T in zip(tile.views, inverse, strict=True)]
    mistake = find_mistake(replace(tile, views=tuple(views)))
    assert mistake is not None and mistake.option == "--invert-extrinsics"
    for axes in ("ros", "opengl"):
        T = np.array([view.T_world_cam for view in tile.views])
        T[:, :3, :3] = T[:, :3, :3] @ conventions.AXES[axes].T
        views = [replace(view, T_world_cam=pose) for view, pose in zip(tile.views, T, strict=True)]
        mistake = find_mistake(replace(tile, views=tuple(views)))
        assert mistake is not None and mistake.option == f"--camera-axes {axes}"


def test_failing_check_is_a_warning(
    street: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(check, "fit", lambda *_: 1 / 0)
    (warning,) = check_photos(street)
    assert "couldn't be checked" in warning and "ZeroDivisionError" in warning
    inspect_path(street)
    shown = " ".join(capsys.readouterr().out.split())
    assert "couldn't be checked" in shown and "ground truth yes" in shown
