"""Pose refinement recovers disturbed poses of photos and keeps correct ones."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.flows.pipelines.graph import Output, TaskId
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.camera.lens import changed_lens, lens_difference
from scan2sim.pipeline.camera.models import inside, pixel_rays, project
from scan2sim.pipeline.camera.renderer import Body, Renderer, look_at
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F64, U8, Camera, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.texturing.pose_refinement.step import PoseRefinementParams, group_by_camera, pose_refinement
from tests.texturing.corner import CAMERAS, GROUND, grid, join

ROOT = Path(__file__).resolve().parents[2]
WALLS = join(  # walls of a courtyard: with ground and three walls, no direction of motion is undetermined
    grid((1, -5, 0), (0, 0, 5), (0, 10, 0)),
    grid((-5, 5, 0), (6, 0, 0), (0, 0, 5)),
    grid((-5, -5, 0), (0, 0, 5), (6, 0, 0)),
)
YS = np.linspace(-3, 3, 9)
POSES = [look_at((-4, y, 1.8), (0, y / 2, 0.6)) for y in YS]
RNG = np.random.default_rng(4)
WAVES = RNG.normal(0, 1, (60, 3)) * np.geomspace(2, 25, 60)[:, None]
PHASES = RNG.uniform(0, 6, 60)


@cache
def marbled(camera: Camera, number: int) -> U8:
    """The photo taken at a pose, of the corner with a non-repeating pattern, so that corners can be matched."""
    pose = POSES[number]
    image = Renderer([Body(GROUND), Body(WALLS)]).view(camera, pose)
    at = pose[:3, 3] + (pixel_rays(camera) @ pose[:3, :3].T) * np.where(image.hit, image.range, 0)[..., None]
    grey = sum(np.sin(at @ wave + phase) for wave, phase in zip(WAVES, PHASES, strict=True))
    grey = np.where(image.hit, 128 + 10 * grey, 220)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def turned(pose: F64, turn: npt.ArrayLike, shift: npt.ArrayLike) -> F64:
    """The pose rotated by a rotation vector (rad) and shifted (m), both in the camera's axes."""
    out = pose.copy()
    out[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.asarray(turn, float))[0]
    out[:3, 3] += pose[:3, :3] @ np.asarray(shift, float)
    return out


def step_inputs(
    folder: Path, camera: Camera, wrong: list[F64], held: tuple[int, ...] = (), given: Camera | None = None
) -> dict[str, Path]:
    """Inputs of the step: photos taken at `POSES` by `camera`, with the poses `wrong` and the camera `given`."""
    views = []
    for i, pose in enumerate(wrong):
        path = folder / f"{i}.png"
        cv2.imwrite(str(path), marbled(camera, i))
        views.append(View(f"cam/{i}", given or camera, pose, path, time=float(i)))
    views_io.save(folder / "views.json", views, [i in held for i in range(len(views))])
    GROUND.save(folder / "ground.npz")
    WALLS.save(folder / "walls.npz")
    return {
        "views": folder / "views.json",
        "mesh.terrain": folder / "ground.npz",
        "mesh.building": folder / "walls.npz",
    }


def run(folder: Path, inputs: dict[str, Path], **params: Any) -> tuple[tuple[View, ...], Done]:
    out = folder / "out"
    out.mkdir()
    done = pose_refinement(inputs, PoseRefinementParams(**params), out, silent)
    return views_io.load(done.files["views"]), done


def displacement(camera: Camera, pose: F64, true: F64, true_camera: Camera | None = None) -> float:
    """Median displacement in pixels of the surface's vertices, projected with a pose and with the true pose."""
    x = np.concatenate([GROUND.vertices, WALLS.vertices])
    there, a = project(true_camera or camera, (x - true[:3, 3]) @ true[:3, :3])
    here, b = project(camera, (x - pose[:3, 3]) @ pose[:3, :3])
    seen = a & b & inside(camera, there)
    return float(np.median(np.linalg.norm(here[seen] - there[seen], axis=1)))


def disturbed(
    rng: np.random.Generator,
    *,
    photo: tuple[float, float] = (0.002, 0.03),
    turn: npt.ArrayLike = (0.005, -0.003, 0.004),
    shift: npt.ArrayLike = (0.03, -0.03, 0.02),
) -> list[F64]:
    """Poses with an error of the camera, and a random one of each photo (standard deviations in radians, metres)."""
    return [
        turned(turned(pose, turn, shift), rng.normal(0, photo[0] / 3**0.5, 3), rng.normal(0, photo[1] / 3**0.5, 3))
        for pose in POSES
    ]


@pytest.mark.parametrize(
    "model",
    ["pinhole", *(pytest.param(m, marks=pytest.mark.slow) for m in ("equirectangular", "opencv", "fisheye"))],
)
def test_disturbed_poses_are_recovered(tmp_path: Path, model: str) -> None:
    camera = CAMERAS[model]
    wrong = disturbed(np.random.default_rng(1))
    views, done = run(tmp_path, step_inputs(tmp_path, camera, wrong))
    before = np.array([displacement(camera, pose, true) for pose, true in zip(wrong, POSES, strict=True)])
    after = np.array([displacement(camera, view.T_world_cam, true) for view, true in zip(views, POSES, strict=True)])
    assert done.metrics["moved"] and done.metrics["displaced_after_px"] < 0.5 * done.metrics["displaced_px"]
    assert np.median(after) < 0.35 * np.median(before) and (after < before).all()


def test_focal_length_and_distortion_are_estimated(tmp_path: Path) -> None:
    true = changed_lens(CAMERAS["pinhole"], np.array([0, 0, 0, 0.01, 0]))
    given = changed_lens(CAMERAS["pinhole"], np.array([0.01, 0, 0, 0, 0]))
    inputs = step_inputs(tmp_path, true, POSES, given=given)
    views, done = run(tmp_path, inputs)
    difference = lens_difference(true, views[0].camera)
    assert abs(difference[0]) < 0.001 and abs(difference[3]) < 0.001 and abs(difference[4]) < 0.001
    assert all(view.camera == views[0].camera for view in views)
    found = done.metrics["cameras"]["cam"]
    assert found["focal_change_percent"] == pytest.approx(-1, abs=0.1)
    assert found["k1_change"] == pytest.approx(0.01, abs=0.001)
    before, after = (displacement(camera, POSES[0], POSES[0], true) for camera in (given, views[0].camera))
    assert after < 0.2 * before
    (tmp_path / "off").mkdir()
    kept, _ = run(tmp_path / "off", inputs, lens=False, corners=100)
    assert all(view.camera == given for view in kept)


def test_implausible_lens_is_rejected_and_reported(tmp_path: Path) -> None:
    given = changed_lens(CAMERAS["pinhole"], np.array([0.08, 0, 0, 0, 0]))
    views, done = run(tmp_path, step_inputs(tmp_path, CAMERAS["pinhole"], POSES, given=given), corners=300)
    assert done.warnings and done.warnings[0].startswith("cam: estimated lens") and views[0].camera == given


def test_correct_poses_are_unchanged_bit_for_bit(tmp_path: Path) -> None:
    inputs = step_inputs(tmp_path, CAMERAS["pinhole"], POSES)
    views, done = run(tmp_path, inputs)
    assert not done.metrics["moved"] and done.metrics["matches"] > 1000
    assert all((view.T_world_cam == pose).all() for view, pose in zip(views, POSES, strict=True))


def test_held_out_photo_does_not_contribute_and_is_interpolated(tmp_path: Path) -> None:
    camera, rng = CAMERAS["pinhole"], np.random.default_rng(2)
    wrong = disturbed(rng, photo=(0.0, 0.0))
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    views, _ = run(tmp_path / "a", step_inputs(tmp_path / "a", camera, wrong, held=(4,)), corners=300)
    assert displacement(camera, views[4].T_world_cam, POSES[4]) < 0.4 * displacement(camera, wrong[4], POSES[4])
    blank = step_inputs(tmp_path / "b", camera, wrong, held=(4,))
    cv2.imwrite(str(tmp_path / "b" / "4.png"), np.zeros((camera.height, camera.width, 3), np.uint8))
    again, _ = run(tmp_path / "b", blank, corners=300)
    assert all((a.T_world_cam == b.T_world_cam).all() for a, b in zip(views, again, strict=True))


def test_implausible_correction_is_rejected_and_reported(tmp_path: Path) -> None:
    camera = CAMERAS["pinhole"]
    wrong = disturbed(np.random.default_rng(3))
    wrong[3] = turned(POSES[3], (0.0, 0.02, 0.0), (0, 0, 0))
    views, done = run(tmp_path, step_inputs(tmp_path, camera, wrong), rotation=2.0, correlation_length=0.1)
    assert [warning.split(":")[0] for warning in done.warnings] == ["cam/3"]
    assert "implausibly large and was rejected" in done.warnings[0]
    assert displacement(camera, views[2].T_world_cam, POSES[2]) < 0.5 * displacement(camera, wrong[2], POSES[2])


def test_stereo_pair_counts_as_two_cameras() -> None:
    camera = CAMERAS["pinhole"]
    view = View("left/0", camera, np.eye(4), Path("left/0.png"))
    names, index = group_by_camera([view, replace(view, name="right/0"), replace(view, name="left/1")])
    assert names == ["left", "right"] and index.tolist() == [0, 1, 0]


def test_photos_without_matches_keep_their_poses(tmp_path: Path) -> None:
    camera = CAMERAS["pinhole"]
    for name, views in (
        ("alone", [View("cam/0", camera, POSES[0], tmp_path / "0.png", time=0.0)]),
        ("above", [View("map", Camera("orthographic", 64, 64, 10.0, 10.0, 31.5, 31.5), POSES[0], tmp_path / "0.png")]),
    ):
        (tmp_path / name).mkdir()
        inputs = step_inputs(tmp_path, camera, POSES[:1])
        views_io.save(tmp_path / "views.json", views)
        refined, done = run(tmp_path / name, inputs)
        assert not done.metrics["moved"] and not done.warnings
        assert all((a.T_world_cam == b.T_world_cam).all() for a, b in zip(refined, views, strict=True))


def test_tiles_without_photos_have_no_refine_task() -> None:
    tile = read_tile(ROOT / "data_samples" / "tile" / "tile.toml")
    tasks = {task.id.name: task for task in build_graph(tile, Settings())}
    assert tasks["score"].inputs["views"] == Output(TaskId("pose_refinement"), "views")
    assert tasks["visibility"].inputs["views"] == Output(TaskId("pose_refinement"), "cameras")
    assert tasks["segment"].inputs["views"] == Output(TaskId("views"), "cameras")
    for other, settings in ((replace(tile, views=()), {}), (tile, {"pose_refinement": {"when": "never"}})):
        assert "pose_refinement" not in {task.step.name for task in build_graph(other, Settings(settings))}
