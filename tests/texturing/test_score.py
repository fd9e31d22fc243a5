"""Step `score` on a synthetic street corner: scores against held-out photos and ground truth."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.camera.renderer import look_at
from scan2sim.pipeline.core.splats import GAIN, OFFSET, PHOTO_WIDTH, SplatLayer
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.pipeline.io import sky
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.photo_cache import camera_of
from scan2sim.texturing.score import ScoreParams, score
from scan2sim.texturing.splats.background import HEIGHT_PX
from tests.fakes import splat_scenes
from tests.texturing.corner import CAMERAS, POSES, Street, paint, points


def inputs_of(street: Street) -> dict[str, Path]:
    """Texture the street and return the inputs of the step."""
    street.texel = 0.04
    folder, _ = street.run()
    return {"terrain": folder, "views": folder.parent / "views.json", "depth": folder.parent / "depth"}


@pytest.fixture(scope="module")
def textured(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Inputs of the step: a textured street with the second of four photos held out."""
    street = Street(tmp_path_factory.mktemp("street"))
    for pose in POSES:
        street.add(CAMERAS["pinhole"], pose)
    street.held_out = (False, True, False, False)
    street.clouds["terrain"] = points()
    return inputs_of(street)


@pytest.fixture(scope="module")
def scored(textured: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Done:
    """Result of the step."""
    return score(textured, ScoreParams(), tmp_path_factory.mktemp("score"), silent)


def strict(facts: Mapping[str, Any]) -> dict[str, Any]:
    """The metrics after a round trip through JSON, which has no NaN."""
    return json.loads(json.dumps(facts, allow_nan=False))


def test_held_out_photo_is_scored_by_class_and_by_distance(scored: Done) -> None:
    facts = strict(scored.metrics)
    assert facts["held_out"] == 1 and list(facts["photos"]) == ["photo1"]
    assert facts["psnr_db"] > 28 and facts["ssim"] > 0.85 and 0.7 < facts["sharpness"] < 1.1
    assert facts["photos"]["photo1"]["psnr_db"] == facts["psnr_db"] == facts["by_class"]["terrain"]["psnr_db"]
    bands = facts["by_distance"]
    assert list(bands) == ["0-5 m", "5-10 m", "10-20 m", "20-40 m", "40+ m"]
    assert sum(band["pixels"] for band in bands.values()) == facts["by_class"]["terrain"]["pixels"] > 10_000
    assert bands["0-5 m"]["psnr_gain_db"] > 25
    assert bands["40+ m"] == {"psnr_db": None, "psnr_gain_db": None, "ssim": None, "pixels": 0}
    assert not scored.warnings


def test_every_held_out_photo_has_an_error_image(scored: Done) -> None:
    folder = scored.files["error"]
    (entry,) = json.loads((folder / "index.json").read_text(encoding="utf-8"))
    assert (entry["role"], entry["title"]) == ("error", "photo1") and "dB" in entry["caption"]
    picture = image.read_rgb(folder / entry["file"])
    assert picture is not None and picture.shape[1] <= 1600


def test_scores_are_none_without_held_out_photos(street: Street, tmp_path: Path) -> None:
    street.add(CAMERAS["pinhole"], POSES[0])
    done = score(inputs_of(street), ScoreParams(), tmp_path, silent)
    facts = strict(done.metrics)
    assert facts["held_out"] == 0 and facts["psnr_db"] is None and facts["sharpness"] is None
    assert json.loads((done.files["error"] / "index.json").read_text(encoding="utf-8")) == []


def test_photos_of_missing_surfaces_are_scored_and_unreadable_ones_reported(street: Street, tmp_path: Path) -> None:
    away = look_at((-4, 0, 1.8), (-9, 0, 4))  # at the sky
    for pose in (POSES[0], POSES[1], away):
        street.add(CAMERAS["pinhole"], pose)
    street.held_out = (False, True, True)
    inputs = inputs_of(street)
    Path(street.views[1].photo).write_bytes(b"no photo")
    done = score(inputs, ScoreParams(), tmp_path, silent)
    facts = strict(done.metrics)
    assert facts["held_out"] == 1 and facts["psnr_db"] == facts["photos"]["photo2"]["psnr_db"] is not None
    assert facts["photos"]["photo2"]["coverage"] == 0
    assert sum(band["pixels"] for band in facts["by_distance"].values()) == 0
    (warning,) = done.warnings
    assert "photo1.png" in warning and "can't be read" in warning


def test_cameras_near_a_surface_are_reported_with_distance(street: Street, tmp_path: Path) -> None:
    low = POSES[1].copy()
    low[2, 3] = 0.4  # the ground is at 0
    for pose in (POSES[0], low):
        street.add(CAMERAS["pinhole"], pose)
    cameras = strict(score(inputs_of(street), ScoreParams(), tmp_path, silent).metrics)["cameras"]
    assert cameras == {"count": 2, "near_m": {"photo1": pytest.approx(0.4, abs=0.05)}}


def test_surfaces_near_cameras_are_compared_with_ground_truth_separately(
    textured: dict[str, Path], tmp_path: Path
) -> None:
    """Ground truth is wrong beyond 5 m from every photo that was not held out."""
    truth = points()
    centres = np.array([pose[:3, 3] for i, pose in enumerate(POSES) if i != 1])
    near = np.linalg.norm(truth.xyz[:, None] - centres, axis=2).min(axis=1) <= 5
    rgb = np.where(near[:, None], np.clip(paint(truth.xyz), 0, 255), 255).astype(np.uint8)
    las.write(tmp_path / "truth.laz", PointCloud(Frame(), truth.xyz, rgb))
    inputs = {**textured, "truth.points": tmp_path / "truth.laz"}
    facts = strict(score(inputs, ScoreParams(near=4.9), tmp_path, silent).metrics)
    assert facts["truth_psnr_near_db"] > 28 > 20 > facts["truth_psnr_db"]


def test_whole_frames_are_scored_by_class_and_distance_of_the_surface_shown(scored: Done) -> None:
    facts = strict(scored.metrics)
    frame = facts["frame"]
    assert list(frame["by_class"]) == ["terrain", "no surface: sky", "no surface: other"]
    assert list(frame["by_distance"])[-1] == "no surface"
    pixels = 640 * 480
    counted = sum(part["pixels"] for part in frame["by_class"].values())
    assert counted == sum(part["pixels"] for part in frame["by_distance"].values())
    assert counted == pytest.approx(pixels * (1 - frame["excluded"]), abs=100)
    assert facts["photos"]["photo1"]["frame_psnr_db"] == frame["psnr_db"] > 25  # the photo's sky is that of the world
    assert frame["ms_ssim"] > 0.9
    (entry,) = json.loads((scored.files["frames"] / "index.json").read_text(encoding="utf-8"))
    assert (entry["role"], entry["title"]) == ("frame", "photo1") and "MS-SSIM" in entry["caption"]


def test_wrong_sky_costs_the_whole_frame_but_not_the_surfaces(
    textured: dict[str, Path], scored: Done, tmp_path: Path
) -> None:
    sky.write(tmp_path / "sky.json", (20, 60, 20))
    facts = strict(score({**textured, "sky": tmp_path / "sky.json"}, ScoreParams(), tmp_path, silent).metrics)
    assert facts["frame"]["psnr_db"] < scored.metrics["frame"]["psnr_db"] - 5
    assert facts["psnr_db"] == scored.metrics["psnr_db"] and facts["ssim"] == scored.metrics["ssim"]


def test_splats_are_scored_in_the_exposure_of_the_world_and_in_that_of_the_nearest_photos(
    textured: dict[str, Path], tmp_path: Path
) -> None:
    """As simulators show them, and as the camera would have shown them."""
    plain, row = splat_scenes.layer(count=50, height=HEIGHT_PX), np.zeros((1, PHOTO_WIDTH), np.float32)
    row[0, GAIN], row[0, OFFSET] = 0.2, 0.011
    dark = SplatLayer(plain.splats, plain.background, row, (camera_of(views_io.load(textured["views"])[1]),))
    found = []
    for name, layer in (("plain", plain), ("dark", dark)):
        (tmp_path / name).mkdir()
        layer.save(tmp_path / f"{name}.npz")
        inputs = {**textured, "splats": tmp_path / f"{name}.npz"}
        facts = strict(score(inputs, ScoreParams(), tmp_path / name, silent).metrics)
        found.append(facts["splat_frame"])
        assert facts["photos"]["photo1"]["splat_frame_psnr_exposed_db"] == facts["splat_frame"]["psnr_exposed_db"]
    assert found[0]["psnr_exposed_db"] == pytest.approx(found[0]["psnr_db"], abs=0.01)
    assert found[1]["psnr_db"] == found[0]["psnr_db"]
    assert abs(found[1]["psnr_exposed_db"] - found[1]["psnr_db"]) > 0.3
