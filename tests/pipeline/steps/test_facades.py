"""Facades: a wall whose lower part was scanned is extended to the height that photos show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.buildings.facade_completion import Rays
from scan2sim.pipeline.camera.models import unproject
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F64, Camera, Frame, PointCloud, Tile, Trajectory, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.facades import FACADES
from scan2sim.pipeline.steps.voxel import VOXEL

SAMPLE = Path(__file__).resolve().parents[3] / "data_samples" / "tile"
FRAME = Frame("local", (100.0, 200.0, 30.0))
WALL, LONG, BEHIND = 7.0, 12.0, 16.0  # metres: y of the wall, its length (x from 0), y of another wall behind it
EYE, LOW = 1.7, np.radians(2.0)  # height of scanner and cameras, and maximum elevation of the scanner's rays
CAMERA = Camera("pinhole", 480, 360, 240.0, 240.0, 239.5, 259.5)
PATH = Trajectory(np.array([0.0, 10.0]), np.array([[-6.0, 0.0, EYE], [18.0, 0.0, EYE]]))


@dataclass(frozen=True)
class Scene:
    """Heights of the wall and of the one behind it, and whether the wall has a pattern; metres."""

    height: float = 5.0
    behind: float = 0.0
    plain: bool = False


def pattern(x: F64, z: F64, seed: int) -> F64:
    """Grey levels at positions on a wall: smoothed noise of 8 cm."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).uniform(0, 255, (400, 800)), (0, 0), 1.0)
    row, column = np.floor(z / 0.04).astype(int) % 400, np.floor(x / 0.04).astype(int) % 800
    return 128 + 2.5 * (noise[row, column] - 128)


def photo(place: F64, scene: Scene) -> np.ndarray:
    """Image of a camera at a position, looking along y: the wall, the other one behind it, sky, ground."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    ray = unproject(CAMERA, np.column_stack([u.ravel(), v.ravel()]))[:, [0, 2, 1]] * (1, 1, -1)
    grey = np.where(ray[:, 2] > 0, 235 - 60 * ray[:, 2], 90.0)
    for y, height, seed in ((BEHIND, scene.behind, 1), (WALL, scene.height, 2)):
        far = (y - place[1]) / ray[:, 1]
        x, z = place[0] + far * ray[:, 0], place[2] + far * ray[:, 2]
        on = (z > 0) & (z < height) & ((y != WALL) | ((x > 0) & (x < LONG)))
        grey = np.where(on, 120.0 if scene.plain and y == WALL else pattern(x, z, seed) - 40 * (y == BEHIND), grey)
    noisy = grey + np.random.default_rng(3).normal(0, 1.5, grey.shape)
    shape = (CAMERA.height, CAMERA.width, 1)
    return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8).reshape(shape), 3, axis=2)


def scanned(x: F64, y: float, z: F64, turns: int = 30) -> tuple[F64, F64]:
    """Positions within the elevation limit of the scanner's rays, and their times."""
    times = np.random.default_rng(4).integers(0, turns, len(x)) / turns * 10
    away = np.hypot(x - PATH.at(times)[:, 0], y)
    seen = z < EYE + away * np.tan(LOW)
    return np.column_stack([x, np.full(len(x), y), z])[seen], times[seen]


def wall(height: float, hole: tuple[float, float, float, float] | None = None, dense: int = 2500) -> tuple[F64, F64]:
    """Scanned points of the wall up to a height, without those in a hole (x, z; from, to)."""
    random = np.random.default_rng(5)
    n = int(dense * LONG * height)
    x, z = random.uniform(0, LONG, n), random.uniform(0, height, n)
    if hole is not None:
        within = (x > hole[0]) & (x < hole[2]) & (z > hole[1]) & (z < hole[3])
        x, z = x[~within], z[~within]
    return scanned(x, WALL, z)


def run_step(
    folder: Path, points: tuple[F64, F64], scene: Scene, others: tuple[F64, F64] | None = None
) -> tuple[PointCloud, Done]:
    """Points that the step synthesizes from a scan and photos."""
    PATH.save(folder / "path.npz")
    random, files = np.random.default_rng(6), {}
    x, y = (random.uniform(-15, 25, 60_000), random.uniform(-5, 6, 60_000))
    ground = np.column_stack([x, y, np.zeros(len(x))]), random.uniform(0, 10, len(x))
    trees = [scanned(random.uniform(-40, 50, 60_000), -15.0, random.uniform(0, 8, 60_000))]  # give the elevation limit
    trees += [scanned(random.uniform(x, x + 40, 40_000), 8.0, random.uniform(0, 8, 40_000)) for x in (-60, 32)]
    across = np.concatenate([xyz for xyz, _ in trees]), np.concatenate([time for _, time in trees])
    parts = {"building": points, "terrain": ground, "vegetation": across}
    parts |= {} if others is None else {"rest": others}
    for name, (xyz, time) in parts.items():
        classification = np.full(len(xyz), CODE["building"], np.uint8)
        noisy = (xyz + random.normal(0, 0.005, xyz.shape)).astype(np.float32)
        PointCloud(FRAME, noisy, classification=classification, time=time).save(folder / f"{name}.npz")
        (folder / name).mkdir()
        inputs = {"cloud": folder / f"{name}.npz", "path": folder / "path.npz"}
        files[name] = VOXEL.run(inputs, VOXEL.params(), folder / name, silent).files["cloud"]
    views = []
    for i, x in enumerate(np.linspace(-4, 16, 11)):
        place = np.array([x, 0.0, EYE])
        cv2.imwrite(str(folder / f"{i}.png"), photo(place, scene))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), place
        views.append(View(f"v{i}", CAMERA, pose, folder / f"{i}.png", time=float(i)))
    views_io.save(folder / "views.json", views, [False] * len(views))
    (folder / "labels").mkdir()
    inputs = {"cloud": files.pop("building")} | {f"other.{name}": file for name, file in files.items()}
    inputs |= {"path": folder / "path.npz", "views": folder / "views.json", "labels": folder / "labels"}
    done = FACADES.run(inputs, FACADES.params(), folder, silent)
    return PointCloud.load(done.files["synthesized"]), done


def tops(made: PointCloud) -> F64:
    """(C,) metres: height of the synthesized wall every half metre along it; 0 without."""
    bins = np.floor(made.xyz[:, 0] / 0.5).astype(int)
    return np.array([made.xyz[bins == k, 2].max(initial=0.0) for k in range(int(LONG / 0.5))])


@pytest.mark.parametrize("height", [3.4, 5.0])
@pytest.mark.parametrize("behind", [0.0, 9.0])
def test_wall_is_extended_to_its_top_in_photos(tmp_path: Path, height: float, behind: float) -> None:
    made, done = run_step(tmp_path, wall(height), Scene(height, behind))
    assert np.abs(tops(made)[1:-1] - height).max() < 0.3
    assert np.ptp(tops(made)[1:-1]) < 0.25, "its top is no straight line"
    assert np.abs(made.xyz[:, 1] - WALL).max() < 0.03
    assert made.xyz[:, 0].min() > -0.1 and made.xyz[:, 0].max() < LONG + 0.1, "it extends beyond the ends of the wall"
    assert done.metrics["above_m2"] > 0.5 * LONG * (height - 2.0)


def test_plain_wall_is_extended_while_its_appearance_continues(tmp_path: Path) -> None:
    made, _ = run_step(tmp_path, wall(4.0), Scene(4.0, plain=True))
    assert np.median(tops(made)) == pytest.approx(4.0, abs=0.2) and tops(made).max() < 4.3


@pytest.mark.parametrize("behind", [0.0, 9.0])
def test_walls_are_not_extended_over_sky_or_other_walls(tmp_path: Path, behind: float) -> None:
    made, _ = run_step(tmp_path, wall(1.9), Scene(1.9, behind))
    assert tops(made).max() < 2.25


def test_wall_is_not_extended_where_rays_pass_above_it(tmp_path: Path) -> None:
    """Rays outweigh photos that consistently show a pattern there."""
    made, _ = run_step(tmp_path, wall(1.2), Scene(5.0))
    assert tops(made).max() < 1.2 + 0.6


def test_gap_without_passing_rays_is_closed(tmp_path: Path) -> None:
    hole = (5.0, 0.5, 5.6, 1.1)
    made, done = run_step(tmp_path, wall(1.9, hole), Scene(1.9))
    inside = (made.xyz[:, 0] > 5.1) & (made.xyz[:, 0] < 5.5) & (made.xyz[:, 2] > 0.6) & (made.xyz[:, 2] < 1.0)
    assert inside.sum() >= 40 and done.metrics["gaps_m2"] > 0.05


def test_window_with_passing_rays_stays_open(tmp_path: Path) -> None:
    hole, random = (5.0, 0.5, 5.6, 1.1), np.random.default_rng(7)
    x, z = random.uniform(-5, 17, 400_000), random.uniform(0, 2, 400_000)
    xyz, time = scanned(x, 9.0, z)  # back wall of a room, seen through the window
    from_ = PATH.at(time)
    share = (WALL - from_[:, 1]) / (xyz[:, 1] - from_[:, 1])
    hit = from_ + share[:, None] * (xyz - from_)
    seen = (hit[:, 0] > hole[0]) & (hit[:, 0] < hole[2]) & (hit[:, 2] > hole[1]) & (hit[:, 2] < hole[3])
    made, _ = run_step(tmp_path, wall(1.9, hole), Scene(1.9), (xyz[seen], time[seen]))
    inside = (made.xyz[:, 0] > 5.15) & (made.xyz[:, 0] < 5.45) & (made.xyz[:, 2] > 0.65) & (made.xyz[:, 2] < 0.95)
    assert not inside.any()


def test_elevation_limits_of_a_tilted_scanner_are_estimated() -> None:
    random = np.random.default_rng(8)
    azimuth = random.uniform(-np.pi, np.pi, 40_000)
    limit = np.radians(2.0) + np.radians(3.0) * np.cos(azimuth - 1.0)
    limit = np.where(np.abs(azimuth + 2) < 0.6, -0.1, limit)  # an open field without high objects
    elevation = limit - random.exponential(0.05, len(azimuth))
    level = random.uniform(5, 30, len(azimuth))
    ends = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), level * np.tan(elevation)])
    limits = np.degrees(Rays.of(np.zeros_like(ends), ends.astype(np.float32)).limit)
    assert limits == pytest.approx([2.0, 3 * np.cos(1.0), 3 * np.sin(1.0)], abs=0.35)


def test_task_exists_only_with_trajectory_and_photos() -> None:
    tile, never = read_tile(SAMPLE / "tile.toml"), Settings({"facades": {"when": "never"}})

    def has(one: Tile, settings: Settings) -> bool:
        return "facades" in {task.full_name for task in build_graph(one, settings)}

    assert has(tile, Settings())
    assert not has(tile, never)
    assert not has(replace(tile, views=()), Settings())
    assert not has(replace(tile, trajectory=None), Settings())
