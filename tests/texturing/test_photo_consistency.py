"""Photos that are inconsistent with the others: ghosts, wrong poses, blur, overexposure."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.camera.renderer import Body, Renderer, look_at
from scan2sim.pipeline.core.classes import PHOTO_CLASSES
from scan2sim.pipeline.core.step import Done
from scan2sim.pipeline.core.types import F64, U8
from tests.texturing.corner import BOX, CAMERAS, GROUND, Street, photograph, points
from tests.texturing.test_texture import from_above

CAMERA = CAMERAS["pinhole"]
POSES = [look_at((-4, y, 1.8), (0, y / 2, 0.6)) for y in (-3.0, -1.5, 0.0, 1.5, 3.0)]


def grainy(pose: F64) -> U8:
    """A photo of the corner with a fine pattern on the ground, to measure sharpness and displacement."""
    return _grainy(pose.astype(float).tobytes()).copy()


@cache
def _grainy(values: bytes) -> U8:
    """Rendered once for all tests."""
    from scan2sim.pipeline.camera.models import pixel_rays

    pose = np.frombuffer(values).reshape(4, 4)
    image = Renderer([Body(GROUND), Body(BOX)]).view(CAMERA, pose)
    at = pose[:3, 3] + (pixel_rays(CAMERA) @ pose[:3, :3].T) * np.where(image.hit, image.range, 0)[..., None]
    grain = 35 * np.sign(np.sin(9 * at[..., 0] + 2 * at[..., 1]) * np.sin(8 * at[..., 1]))
    plain = photograph(CAMERA, pose).astype(float)
    return np.clip(plain + grain[..., None], 0, 255).astype(np.uint8)


def rows_of(folder: Path) -> dict[str, Any]:
    """Rows of `photo_consistency.json` by name of the photo."""
    return {
        row["name"]: row
        for row in json.loads(
            (folder.parent / "photo_consistency" / "photo_consistency.json").read_text(encoding="utf-8")
        )
    }


def test_passing_car_is_masked_as_ghost(street: Street) -> None:
    for i, pose in enumerate(POSES):
        image = photograph(CAMERA, pose)
        if i == 2:
            image[310:390, 260:400] = (255, 0, 255)  # on ground that the others see too
        street.add(CAMERA, pose, image)
    street.clouds["terrain"] = points()

    def magenta(**given: Any) -> tuple[int, Done]:
        folder, done = street.run(band=0, **given)
        rgb, *_ = from_above(folder)
        return int(((rgb[..., 0] > 150) & (rgb[..., 1] < 90) & (rgb[..., 2] > 150)).sum()), done

    without, done = magenta()
    assert without == 0
    assert done.metrics["coverage"] > 0.3
    assert magenta(agreement={"ghosts": False})[0] > 50


def test_traffic_sign_is_not_a_ghost(street: Street, tmp_path: Path) -> None:
    """A panel slightly off the surface, which only the nearest photo shows at the correct position."""
    for i, pose in enumerate(POSES):
        image = photograph(CAMERA, pose)
        if i == 2:
            image[310:390, 260:400] = (255, 0, 255)
        street.add(CAMERA, pose, image)
    panel = np.zeros((60, 80, len(PHOTO_CLASSES)), np.uint8)
    panel[..., PHOTO_CLASSES.index("road")] = 255
    rows, columns = 60 / CAMERA.height, 80 / CAMERA.width
    panel[round(310 * rows) : round(390 * rows), round(260 * columns) : round(400 * columns)] = np.where(
        np.arange(len(PHOTO_CLASSES)) == PHOTO_CLASSES.index("road_sign"), 255, 0
    )
    np.save(tmp_path / "2.npy", panel)
    street.labels = tmp_path
    folder, _ = street.run(band=0)
    rgb, *_ = from_above(folder)
    assert ((rgb[..., 0] > 150) & (rgb[..., 1] < 90) & (rgb[..., 2] > 150)).sum() > 50


@pytest.mark.parametrize("turn, shift", [(0.5, 0.0), (0.0, 0.2)])
def test_photo_with_wrong_pose_is_excluded_and_reported(street: Street, turn: float, shift: float) -> None:
    for i, pose in enumerate(POSES):
        true = pose.copy()
        if i == 3:
            c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
            true[:3, :3] = pose[:3, :3] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
            true[1, 3] += shift
        street.add(CAMERA, pose, grainy(true))
    folder, done = street.run(agreement={"max_shift": 2.0})
    rows = rows_of(folder)
    assert [name for name, row in rows.items() if not row["usable"]] == ["photo3"]
    assert rows["photo3"]["shift_px"] > 2 and max(rows[f"photo{i}"]["shift_px"] for i in (0, 1, 2, 4)) < 1.5
    assert any("photo3" in warning and "pixels" in warning for warning in done.warnings)
    assert "photo3" not in done.metrics["texels_by_photo"]


def test_blurred_photo_is_down_weighted(street: Street) -> None:
    for i, pose in enumerate(POSES):
        image = grainy(pose)
        street.add(CAMERA, pose, cv2.GaussianBlur(image, (0, 0), 4) if i == 2 else image)
    folder, done = street.run()
    rows = rows_of(folder)
    assert rows["photo2"]["sharpness_factor"] < 0.5
    assert all(rows[f"photo{i}"]["sharpness_factor"] == 1 for i in (0, 1, 3, 4))
    assert any("photo2" in warning and "blurred" in warning for warning in done.warnings)


def test_overexposed_photo_is_excluded(street: Street) -> None:
    for i, pose in enumerate(POSES):
        street.add(CAMERA, pose, np.full((480, 640, 3), 255, np.uint8) if i == 1 else None)
    _, done = street.run()
    assert any("photo1" in warning and "overexposed" in warning for warning in done.warnings)
    assert "photo1" not in done.metrics["texels_by_photo"]


def test_consistent_photos_are_used_without_masks(street: Street) -> None:
    for pose in POSES:
        street.add(CAMERA, pose)
    folder, done = street.run()
    assert not done.warnings and done.metrics["photos"] == len(POSES)
    assert max(row.get("ghost_share", 0) for row in rows_of(folder).values()) < 0.01


def test_single_photo_is_used(street: Street) -> None:
    street.add(CAMERA, POSES[2])
    _, done = street.run()
    assert done.metrics["photos"] == 1 and not done.warnings
