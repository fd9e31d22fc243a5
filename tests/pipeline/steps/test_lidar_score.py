"""Held-out sweeps of a cloud, and the score of a world by them: a small scene, and a scan of the synthetic street."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F32, F64, Bools, Frame, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.io.geodata import geojson
from scan2sim.pipeline.lidar.sweeps import Sweeps
from scan2sim.pipeline.steps.lidar_score import LIDAR_SCORE
from scan2sim.pipeline.steps.sweeps import SWEEPS
from tests.fakes.steps import step_params
from tests.present import present

TURNS, HEIGHT = 17, 2.0
CAR = (6.0, 10.0, 2.0, 4.0)
"""Ground box of a parked car in the scene: x and y from, to."""


def ground(half: float = 60.0) -> Mesh:
    corners = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]], np.float32)
    return Mesh(Frame(), corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def sweep(origin: F64) -> F32:
    """Returns (N, 3) of a turn over level ground."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 1.0)), np.radians(-np.arange(5, 25, 1.0)))
    flat = np.cos(elevation)
    way = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    return (origin + way * (HEIGHT / -way[:, 2])[:, None]).astype(np.float32)


def in_car(xyz: F32) -> Bools:
    x, y = xyz[:, 0], xyz[:, 1]
    return np.asarray((x > CAR[0]) & (x < CAR[1]) & (y > CAR[2]) & (y < CAR[3]))


@pytest.fixture
def drive(tmp_path: Path) -> tuple[PointCloud, dict[str, Path]]:
    """A scanner drives 1 m per turn; the points of a car are 1 m above the ground."""
    times = np.asarray(50 + 0.1 * np.arange(TURNS), np.float64)
    origins = np.column_stack([np.arange(TURNS), np.zeros(TURNS), np.full(TURNS, HEIGHT)]).astype(np.float64)
    parts = [sweep(origin) for origin in origins]
    xyz = np.concatenate(parts)
    car = in_car(xyz)
    xyz[car, 2] = 1
    classification = np.where(car, CODE["vehicle"], CODE["terrain"]).astype(np.uint8)
    cloud = PointCloud(Frame(), xyz, classification=classification, time=np.repeat(times, len(parts[0])))
    cloud.save(tmp_path / "cloud.npz")
    Trajectory(times, origins).save(tmp_path / "path.npz")
    return cloud, {name: tmp_path / f"{name}.npz" for name in ("cloud", "path")}


def run_sweeps(inputs: dict[str, Path], tmp_path: Path, **settings: Any) -> tuple[Done, PointCloud, Sweeps]:
    out = tmp_path / "sweeps"
    out.mkdir()
    done = SWEEPS.run(inputs, step_params(SWEEPS.params, **settings), out, silent)
    return done, PointCloud.load(done.files["cloud"]), Sweeps.load(done.files["sweeps"])


def run_score(tmp_path: Path, files: dict[str, Path], **context: Any) -> Done:
    out, moving = tmp_path / "score", tmp_path / "moving.npz"
    out.mkdir()
    if not moving.exists():
        PointCloud(Frame(), np.zeros((0, 3), np.float32), time=np.zeros(0)).save(moving)
    return LIDAR_SCORE.run({**files, "moving": moving}, step_params(LIDAR_SCORE.params, **context), out, silent)


def test_every_8th_sweep_is_held_out(drive: tuple[PointCloud, dict[str, Path]], tmp_path: Path) -> None:
    cloud, inputs = drive
    done, kept, sweeps = run_sweeps(inputs, tmp_path, hold_out=8)
    assert done.metrics == {"sweeps": TURNS, "scored": 2, "held_out": 2, "reason": ""} and not done.warnings
    assert np.unique(sweeps.number).tolist() == [4, 12] and len(kept) + len(sweeps) == len(cloud)
    assert not np.isin(np.round(present(kept.time), 3), [50.4, 51.2]).any()
    assert np.unique(sweeps.origins[:, 0]).tolist() == [4, 12]
    assert np.allclose(sweeps.scanned, sweeps.xyz - sweeps.origins, atol=1e-4)  # along x


def test_sweeps_of_the_cloud_are_scored_without_held_out_ones(
    drive: tuple[PointCloud, dict[str, Path]], tmp_path: Path
) -> None:
    done, kept, sweeps = run_sweeps(drive[1], tmp_path)
    assert len(kept) == len(drive[0]) and done.metrics["held_out"] == 0 and done.metrics["scored"] == 2
    assert np.unique(sweeps.number).tolist() == [4, 12]


def test_no_sweep_is_held_out_where_each_location_was_scanned_once(tmp_path: Path) -> None:
    """A profile scanner: each turn sees one plane across the street, a metre from the next."""
    across = np.column_stack([np.zeros(2000), np.linspace(-5, 5, 2000), np.zeros(2000)])
    xyz = np.concatenate([across + [k, 0, 0] for k in range(16)]).astype(np.float32)
    times = np.arange(16, dtype=np.float64)
    PointCloud(Frame(), xyz, time=np.repeat(times, 2000)).save(tmp_path / "cloud.npz")
    Trajectory(times, np.column_stack([times, 0 * times, 0 * times + 2])).save(tmp_path / "path.npz")
    inputs = {name: tmp_path / f"{name}.npz" for name in ("cloud", "path")}
    done, kept, sweeps = run_sweeps(inputs, tmp_path, hold_out=8)
    assert len(kept) == len(xyz) and done.metrics["held_out"] == 0 and len(sweeps) > 0
    assert "gaps" in done.warnings[0]


def test_points_without_times_have_no_sweeps(drive: tuple[PointCloud, dict[str, Path]], tmp_path: Path) -> None:
    PointCloud(Frame(), drive[0].xyz).save(drive[1]["cloud"])
    done, kept, sweeps = run_sweeps(drive[1], tmp_path, hold_out=8)
    assert done.metrics["reason"] == "the points have no times" and not len(sweeps) and len(kept) == len(drive[0])
    ground().save(tmp_path / "mesh.npz")
    drive[0].save(drive[1]["cloud"])
    files = {"sweeps": done.files["sweeps"], "mesh.terrain": tmp_path / "mesh.npz", "cloud": drive[1]["cloud"]}
    scored = run_score(tmp_path, files).metrics
    assert scored["rays"] == 0 and scored["all"]["median_m"] is None and not scored["sweeps"]


def test_holding_out_every_sweep_is_rejected() -> None:
    with pytest.raises(SettingError, match=r"0 or 2 to"):
        SWEEPS.params.of("sweeps", {"hold_out": 1})


def test_returns_from_a_removed_car_do_not_count(drive: tuple[PointCloud, dict[str, Path]], tmp_path: Path) -> None:
    """Returns in its box are excluded even if no nearby point has its class; those of a kept car count as missing."""
    done, kept, _ = run_sweeps(drive[1], tmp_path, hold_out=8)
    ground().save(tmp_path / "mesh.npz")
    (x0, x1, y0, y1), car = CAR, {"kind": "car", "moved": False, "height_m": 1.5, "ground_z": 0.0}
    geojson.write_polygons(
        tmp_path / "instances.geojson", "local", [([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], car)]
    )
    plain = PointCloud(Frame(), kept.xyz, classification=np.full(len(kept), CODE["terrain"], np.uint8))
    plain.save(tmp_path / "plain.npz")
    files = {
        "sweeps": done.files["sweeps"], "mesh.terrain": tmp_path / "mesh.npz", "cloud": tmp_path / "plain.npz",
        "instances": tmp_path / "instances.geojson",
    }  # fmt: skip
    scored = run_score(tmp_path, files).metrics
    assert scored["excluded"] > 0 and scored["by_surface"]["terrain"]["early_20cm"] == 0
    assert scored["all"]["median_m"] < 1e-3 and scored["all"]["late_50cm"] == 0 and scored["all"]["missing"] == 0
    assert scored["range_image"]["f_score"] == 1
    (tmp_path / "score").rename(tmp_path / "score_removed")
    kept_car = run_score(tmp_path, files, vehicles=True).metrics
    assert kept_car["excluded"] == 0 and kept_car["all"]["late_50cm"] > 0


def test_returns_next_to_moving_points_of_their_sweep_do_not_count(
    drive: tuple[PointCloud, dict[str, Path]], tmp_path: Path
) -> None:
    done, kept, sweeps = run_sweeps(drive[1], tmp_path, hold_out=8)
    ground().save(tmp_path / "mesh.npz")
    at = np.array([[8, -2, 0]], np.float32)  # both sweeps have returns there
    PointCloud(Frame(), at, time=np.array([50.4])).save(tmp_path / "moving.npz")
    PointCloud(Frame(), kept.xyz, classification=np.full(len(kept), CODE["terrain"], np.uint8)).save(
        tmp_path / "plain.npz"
    )
    files = {"sweeps": done.files["sweeps"], "mesh.terrain": tmp_path / "mesh.npz", "cloud": tmp_path / "plain.npz"}
    near = np.linalg.norm(sweeps.xyz - at, axis=1) < 0.3
    assert 0 < (near & (sweeps.number == 4)).sum() < near.sum()
    assert run_score(tmp_path, files).metrics["rays"] == len(sweeps) - (near & (sweeps.number == 4)).sum()


def test_without_instances_returns_next_to_points_of_a_removed_class_do_not_count(
    drive: tuple[PointCloud, dict[str, Path]], tmp_path: Path
) -> None:
    done, _, _ = run_sweeps(drive[1], tmp_path, hold_out=8)
    ground().save(tmp_path / "mesh.npz")
    files = {"sweeps": done.files["sweeps"], "mesh.terrain": tmp_path / "mesh.npz", "cloud": done.files["cloud"]}
    scored = run_score(tmp_path, files).metrics
    assert scored["excluded"] > 0 and scored["all"]["late_50cm"] == 0


def test_only_rays_inside_the_cell_count(drive: tuple[PointCloud, dict[str, Path]], tmp_path: Path) -> None:
    done, _, sweeps = run_sweeps(drive[1], tmp_path)
    ground().save(tmp_path / "mesh.npz")
    files = {"sweeps": done.files["sweeps"], "mesh.terrain": tmp_path / "mesh.npz", "cloud": done.files["cloud"]}
    cell = {"name": "a", "seed": (0.0, 0.0), "neighbours": {"b": (20.0, 0.0)}}  # its border is at x = 10
    scored = run_score(tmp_path, files, cell=cell).metrics
    inside = (sweeps.xyz[:, 0] <= 10) & (sweeps.origins[:, 0] <= 10)
    assert 0.9 * inside.sum() < scored["rays"] <= inside.sum() and list(scored["sweeps"]) == ["Sweep 4."]


def test_true_surface_of_a_synthetic_street_agrees_with_its_scan(small_street: Path, tmp_path: Path) -> None:
    """Range noise has a standard deviation of 1 cm: the median absolute error is .67 cm on every surface."""
    from scan2sim.pipeline.core.classes import GROUPS, group_of
    from scan2sim.pipeline.io.clouds import las
    from scan2sim.pipeline.io.tile import read_tile

    tile = read_tile(small_street)
    cloud = las.read(tile.clouds[0], tile.frame)
    cloud.save(tmp_path / "cloud.npz")
    present(tile.trajectory).save(tmp_path / "path.npz")
    truth = Mesh.load(present(tile.truth_mesh)).moved_to(tile.frame)
    done, _, sweeps = run_sweeps({name: tmp_path / f"{name}.npz" for name in ("cloud", "path")}, tmp_path, hold_out=8)
    assert done.metrics["held_out"] > 0 and len(sweeps) > 0
    files = {"sweeps": done.files["sweeps"], "cloud": tmp_path / "cloud.npz"}
    for group in GROUPS:
        files[f"mesh.{group}"] = tmp_path / f"{group}.npz"
        truth.keep(group_of()[present(truth.classification)] == GROUPS.index(group)).save(files[f"mesh.{group}"])
    scored = run_score(tmp_path, files).metrics
    for name in ("terrain", "building", "vegetation"):
        assert scored["by_surface"][name]["median_m"] == pytest.approx(0.0067, abs=0.001)
    assert scored["all"]["missing"] < 0.002 and scored["all"]["early_20cm"] < 0.002
    assert scored["all"]["near_surface"] > 0.999 and scored["range_image"]["f_score"] > 0.99
