"""Dynamic object removal by free space: a scanner drives through a small scene with known static and moving points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest

from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Frame, PointCloud, Trajectory
from scan2sim.pipeline.steps.dynamic_objects import DYNAMIC_OBJECTS
from tests.fakes.steps import step_params

SPEED, TURNS, SECONDS = 10.0, 10.0, 2.5
HEIGHT = 1.8
GROUND, WALL, POLE, WIRE, FENCE, PARKED, LEAF, AHEAD, ONCOMING, CROSSING = range(10)
MOVES = (AHEAD, ONCOMING, CROSSING)


def box(low: tuple[float, ...], high: tuple[float, ...]) -> Any:
    size = np.subtract(high, low)
    mesh = o3d.geometry.TriangleMesh.create_box(*size)
    return mesh.translate(low)


def static_objects() -> dict[int, list[Any]]:
    """Meshes of static objects by kind: a street along x, whose lanes are at y = 0 and 3.5."""
    random = np.random.default_rng(1)
    leaves = []
    for x, y, z in random.normal((12, -5, 3.2), 0.7, (250, 3)):
        leaf = o3d.geometry.TriangleMesh.create_box(0.07, 0.07, 0.004)
        leaf.rotate(o3d.geometry.get_rotation_matrix_from_xyz(random.uniform(0, 3, 3)), center=(0, 0, 0))
        leaves.append(leaf.translate((x, y, z)))
    return {
        GROUND: [box((-40, -40, -0.2), (70, 40, 0))],
        WALL: [box((-20, 9, 0), (50, 9.3, 6))],
        POLE: [box((x, -3.05, 0), (x + 0.1, -2.95, 5)) for x in (-4, 6, 16, 26)],
        WIRE: [box((-10, -4.5, 3.0), (40, -4.48, 3.02))],
        FENCE: [box((x, -7, 0), (x + 0.06, -6.97, 1.4)) for x in np.arange(-10, 35, 0.2)],
        PARKED: [box((8, 6.3, 0.2), (12.4, 8.1, 1.5))],
        LEAF: leaves,
    }


def moving_objects(time: float) -> dict[int, Any]:
    """Meshes of moving objects by kind: a van ahead at the scanner's speed, an oncoming car, a crossing pedestrian."""
    return {
        AHEAD: box((SPEED * time + 9, -1, 0.2), (SPEED * time + 13.5, 1, 2.1)),
        ONCOMING: box((30 - 13 * time, 2.6, 0.2), (34.5 - 13 * time, 4.4, 1.5)),
        CROSSING: box((24, -2 + 1.6 * time, 0), (24.5, -1.5 + 1.6 * time, 1.8)),
    }


def survey(seconds: float = SECONDS, *, off: float = 0.0, begin: float = 0.0, left: int = -1) -> PointCloud:
    """Turns of 64 beams, 2 cm of range noise, poses off by `off` metres, without kind `left`; classes are kinds."""
    random = np.random.default_rng(2)
    elevation = np.radians(np.linspace(-25, 12, 64))
    parts = []
    for turn in range(round(seconds * TURNS)):
        time = turn / TURNS
        scene, kinds = o3d.t.geometry.RaycastingScene(), []
        things = [(k, mesh) for k, meshes in static_objects().items() for mesh in meshes if k != left]
        for kind, mesh in things + list(moving_objects(time).items()):
            scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
            kinds.append(kind)
        azimuth = np.linspace(-np.pi, np.pi, 900, endpoint=False)
        e, a = (part.ravel() for part in np.meshgrid(elevation, azimuth))
        d = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        o = np.array([SPEED * time, 0, HEIGHT])
        hit = scene.cast_rays(np.concatenate([np.broadcast_to(o, d.shape), d], axis=1).astype(np.float32))
        r, what = hit["t_hit"].numpy(), hit["geometry_ids"].numpy()
        good = r < 50
        noisy = r[good] + random.normal(0, 0.02, good.sum())
        shift = random.normal(0, off, 3) if off else 0.0
        parts.append(
            PointCloud(
                Frame(),
                (o + d[good] * noisy[:, None] + shift).astype(np.float32),
                classification=np.array(kinds, np.uint8)[what[good]],
                time=np.full(good.sum(), begin + time),
            )
        )
    return PointCloud.join(parts)


def path(seconds: float = SECONDS, begin: float = 0.0) -> Trajectory:
    times = np.arange(-0.1, seconds + 0.1, 0.05)
    return Trajectory(begin + times, np.column_stack([SPEED * times, 0 * times, HEIGHT + 0 * times]))


def run_step(cloud: PointCloud, out: Path, way: Trajectory | None, **params: Any) -> Done:
    out.mkdir(parents=True, exist_ok=True)
    cloud.save(out / "in.npz")
    inputs = {"cloud": out / "in.npz"}
    if way is not None:
        way.save(out / "path.npz")
        inputs["path"] = out / "path.npz"
    return DYNAMIC_OBJECTS.run(inputs, step_params(DYNAMIC_OBJECTS.params, **params), out, silent)


def removed_share(cloud: PointCloud, done: Done) -> dict[int, float]:
    """Share of removed points by kind."""
    kept = PointCloud.load(done.files["cloud"]).classification
    assert cloud.classification is not None and kept is not None
    before, after = np.bincount(cloud.classification, minlength=10), np.bincount(kept, minlength=10)
    return {kind: float(1 - after[kind] / before[kind]) for kind in np.flatnonzero(before).tolist()}


@pytest.fixture(scope="module")
def street() -> PointCloud:
    return survey()


def test_moving_objects_are_removed_and_static_ones_kept(street: PointCloud, tmp_path: Path) -> None:
    done = run_step(street, tmp_path, path())
    gone = removed_share(street, done)
    assert all(gone[kind] > 0.65 for kind in MOVES)
    assert all(share < 0.01 for kind, share in gone.items() if kind not in MOVES)
    moving = PointCloud.load(done.files["moving"])
    assert len(moving) == done.metrics["moved"] and moving.time is not None and moving.normal is not None
    dropped = np.load(done.files["dropped"])
    np.testing.assert_array_equal(street.xyz[dropped == 0], PointCloud.load(done.files["cloud"]).xyz)


def test_moving_objects_are_removed_in_spite_of_pose_errors(tmp_path: Path) -> None:
    cloud = survey(off=0.05)
    gone = removed_share(cloud, run_step(cloud, tmp_path, path()))
    assert all(gone[kind] > 0.5 for kind in MOVES)
    assert all(share < 0.02 for kind, share in gone.items() if kind not in MOVES)


def test_nothing_is_removed_without_path_times_or_second_view(street: PointCloud, tmp_path: Path) -> None:
    cases = (
        (street, None, "path"),
        (PointCloud(street.frame, street.xyz), path(), "times"),
        (street, path(begin=5000.0), "overlap in time"),
    )
    for i, (cloud, way, why) in enumerate(cases):
        done = run_step(cloud, tmp_path / str(i), way, positions=((0.0, 0.0, 30.0),))
        assert why in str(done.metrics["rays"]) and not len(PointCloud.load(done.files["moving"]))
        assert way is not None or len(PointCloud.load(done.files["cloud"])) == len(cloud)
    assert street.time is not None
    once = run_step(street.take(street.time == 0.5), tmp_path / "once", path())
    assert once.metrics["moved"] == 0 and "observed only once" in str(once.metrics["rays"])


def test_profile_scanner_removes_nothing_in_one_pass(tmp_path: Path) -> None:
    """It scans each position once, beside itself; the car that it passes is kept, and the metrics report the reason."""
    random = np.random.default_rng(3)
    x = random.uniform(0, 20, 60_000)
    y = np.where((x > 8) & (x < 12), 3.0, 6.0)
    xyz = np.column_stack([x, y, random.uniform(0, 2, len(x))]).astype(np.float32)
    done = run_step(PointCloud(Frame(), xyz, time=x / SPEED), tmp_path, path())
    assert done.metrics["moved"] == 0 and "observed only once" in str(done.metrics["rays"])
    assert len(PointCloud.load(done.files["cloud"])) == len(x)


def test_points_of_the_recording_vehicle_and_near_cameras_are_removed(street: PointCloud, tmp_path: Path) -> None:
    """Returns from the car's roof and mirrors, and from an object close to a lens; the road below is kept."""
    places = np.array([[5.0, 0.8, 1.2], [6.0, -0.5, 1.7], [20.0, 0.0, 0.6], [9.0, 6.0, 8.3], [9.0, 6.0, 9.2]])
    extra = PointCloud(
        street.frame, places.astype(np.float32), classification=np.full(5, POLE, np.uint8), time=np.full(5, 1.0)
    )
    cloud = PointCloud.join([street, extra])
    done = run_step(cloud, tmp_path, path(), positions=((9.0, 6.0, 8.0),))
    kept = np.load(done.files["dropped"]) == 0
    assert kept[-5:].tolist() == [False, False, False, False, True]
    assert cloud.classification is not None and kept[cloud.classification == GROUND].all()


def test_objects_absent_in_a_later_pass_are_removed(tmp_path: Path) -> None:
    """A car that is parked during the first pass has left before the second one, two hours later."""
    cloud = PointCloud.join([survey(1.5), survey(1.5, begin=7200.0, left=PARKED)])
    both = path(1.5), path(1.5, begin=7200.0)
    way = Trajectory(*(np.concatenate([getattr(one, of) for one in both]) for of in ("times", "positions")))
    gone = removed_share(cloud, run_step(cloud, tmp_path, way))
    assert gone[PARKED] > 0.8
    assert all(share < 0.01 for kind, share in gone.items() if kind not in (PARKED, *MOVES))
