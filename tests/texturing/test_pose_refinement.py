"""Poses of photos that are known to be wrong come back to where they were; right ones stay."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.flows.pipelines.graph import NodeId, Output
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import recipe
from scan2sim.pipeline.camera.models import inside, pixel_rays, project
from scan2sim.pipeline.camera.renderer import Body, Renderer, look_at
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F64, U8, Camera, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.texturing.pose_refinement.step import RefineParams, lenses, refine
from tests.texturing.corner import CAMERAS, GROUND, grid, join

ROOT = Path(__file__).resolve().parents[2]
WALLS = join(  # of a court: ground and three walls leave nothing to slide along
    grid((1, -5, 0), (0, 0, 5), (0, 10, 0)),
    grid((-5, 5, 0), (6, 0, 0), (0, 0, 5)),
    grid((-5, -5, 0), (0, 0, 5), (6, 0, 0)),
)
YS = np.linspace(-3, 3, 9)
POSES = [look_at((-4, y, 1.8), (0, y / 2, 0.6)) for y in YS]
RNG = np.random.default_rng(4)
WAVES = RNG.normal(0, 1, (60, 3)) * np.geomspace(2, 25, 60)[:, None]
PHASES = RNG.uniform(0, 6, 60)


def marbled(camera: Camera, pose: F64) -> U8:
    """A photo of the corner with a pattern that nowhere repeats: something to find again."""

    image = Renderer([Body(GROUND), Body(WALLS)]).view(camera, pose)
    at = pose[:3, 3] + (pixel_rays(camera) @ pose[:3, :3].T) * np.where(image.hit, image.range, 0)[..., None]
    grey = sum(np.sin(at @ wave + phase) for wave, phase in zip(WAVES, PHASES, strict=True))
    grey = np.where(image.hit, 128 + 10 * grey, 220)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def turned(pose: F64, turn: npt.ArrayLike, shift: npt.ArrayLike) -> F64:
    """The pose turned by a rotation vector (rad) and shifted (m), both in the camera's axes."""
    out = pose.copy()
    out[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.asarray(turn, float))[0]
    out[:3, 3] += pose[:3, :3] @ np.asarray(shift, float)
    return out


def made(folder: Path, camera: Camera, wrong: list[F64], held: tuple[int, ...] = ()) -> dict[str, Path]:
    """Inputs of the step: photos taken at POSES, said to be taken at `wrong`."""
    views = []
    for i, (true, pose) in enumerate(zip(POSES, wrong, strict=False)):
        path = folder / f"{i}.png"
        cv2.imwrite(str(path), marbled(camera, true))
        views.append(View(f"cam/{i}", camera, pose, path, time=float(i)))
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
    done = refine(inputs, RefineParams(**params), out, silent)
    return views_io.load(done.files["views"]), done


def off(camera: Camera, pose: F64, true: F64) -> float:
    """Pixels, median, by which a pose shows the surface elsewhere than the true one."""
    x = np.concatenate([GROUND.vertices, WALLS.vertices])
    there, a = project(camera, (x - true[:3, 3]) @ true[:3, :3])
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
    """Poses with an error of the camera's, and one of each photo's (standard deviations: radians, metres)."""
    return [
        turned(turned(pose, turn, shift), rng.normal(0, photo[0] / 3**0.5, 3), rng.normal(0, photo[1] / 3**0.5, 3))
        for pose in POSES
    ]


@pytest.mark.parametrize(
    "model", ["pinhole", "equirectangular", *(pytest.param(m, marks=pytest.mark.slow) for m in ("opencv", "fisheye"))]
)
def test_disturbed_poses_come_back(tmp_path: Path, model: str) -> None:
    camera = CAMERAS[model]
    wrong = disturbed(np.random.default_rng(1))
    views, done = run(tmp_path, made(tmp_path, camera, wrong))
    before = np.array([off(camera, pose, true) for pose, true in zip(wrong, POSES, strict=True)])
    after = np.array([off(camera, view.T_world_cam, true) for view, true in zip(views, POSES, strict=True)])
    assert done.facts["moved"] and done.facts["displaced_after_px"] < 0.5 * done.facts["displaced_px"]
    assert np.median(after) < 0.35 * np.median(before) and (after < before).all()


def test_right_poses_stay_to_the_last_bit(tmp_path: Path) -> None:
    inputs = made(tmp_path, CAMERAS["pinhole"], POSES)
    views, done = run(tmp_path, inputs)
    assert not done.facts["moved"] and done.facts["matches"] > 1000
    assert all((view.T_world_cam == pose).all() for view, pose in zip(views, POSES, strict=True))


def test_a_photo_held_out_moves_nobody_and_goes_with_its_neighbours(tmp_path: Path) -> None:
    camera, rng = CAMERAS["pinhole"], np.random.default_rng(2)
    wrong = disturbed(rng, photo=(0.0, 0.0))
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    views, _ = run(tmp_path / "a", made(tmp_path / "a", camera, wrong, held=(4,)))
    assert off(camera, views[4].T_world_cam, POSES[4]) < 0.4 * off(camera, wrong[4], POSES[4])
    blank = made(tmp_path / "b", camera, wrong, held=(4,))
    cv2.imwrite(str(tmp_path / "b" / "4.png"), np.zeros((camera.height, camera.width, 3), np.uint8))
    again, _ = run(tmp_path / "b", blank)
    assert all((a.T_world_cam == b.T_world_cam).all() for a, b in zip(views, again, strict=True))


def test_an_unbelievable_pose_is_left_and_named(tmp_path: Path) -> None:
    camera = CAMERAS["pinhole"]
    wrong = disturbed(np.random.default_rng(3))
    wrong[3] = turned(POSES[3], (0.0, 0.02, 0.0), (0, 0, 0))
    views, done = run(tmp_path, made(tmp_path, camera, wrong), turn=2.0, wander=0.1)
    assert [warning.split(":")[0] for warning in done.warnings] == ["cam/3"]
    assert "not moved by it" in done.warnings[0]
    assert off(camera, views[2].T_world_cam, POSES[2]) < 0.5 * off(camera, wrong[2], POSES[2])


def test_cameras_of_a_pair_are_two() -> None:
    camera = CAMERAS["pinhole"]
    view = View("left/0", camera, np.eye(4), Path("left/0.png"))
    names, index = lenses([view, replace(view, name="right/0"), replace(view, name="left/1")])
    assert names == ["left", "right"] and index.tolist() == [0, 1, 0]


def test_photos_that_cannot_be_compared_stay(tmp_path: Path) -> None:
    camera = CAMERAS["pinhole"]
    for name, views in (
        ("alone", [View("cam/0", camera, POSES[0], tmp_path / "0.png", time=0.0)]),
        ("above", [View("map", Camera("orthographic", 64, 64, 10.0, 10.0, 31.5, 31.5), POSES[0], tmp_path / "0.png")]),
    ):
        (tmp_path / name).mkdir()
        inputs = made(tmp_path, camera, POSES[:1])
        views_io.save(tmp_path / "views.json", views)
        refined, done = run(tmp_path / name, inputs)
        assert not done.facts["moved"] and not done.warnings
        assert all((a.T_world_cam == b.T_world_cam).all() for a, b in zip(refined, views, strict=True))


def test_tiles_without_photos_have_no_such_node() -> None:
    tile = read_tile(ROOT / "data_samples" / "tile" / "tile.toml")
    nodes = {node.id.name: node for node in recipe(tile, Settings())}
    assert nodes["visibility"].inputs["views"] == nodes["score"].inputs["views"] == Output(NodeId("refine"), "views")
    assert nodes["segment"].inputs["views"] == Output(NodeId("views"), "views")
    for other, settings in ((replace(tile, views=()), {}), (tile, {"refine": {"when": "never"}})):
        assert "refine" not in {node.step.name for node in recipe(other, Settings(settings))}
