"""Synthetic buildings and the maps that robots record in them agree with their ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.data_samples.building import LAS_CODE, Building, Style, Surface, build
from scan2sim.data_samples.robot_map import (
    AXES,
    Lidar,
    Mapping,
    RobotMap,
    drive,
    random_rotation,
    record,
    write,
)
from scan2sim.data_samples.scene import caster
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F64, Frame, Mesh, Trajectory
from scan2sim.pipeline.io import clouds
from tests.present import present

HOUSE = Style(storeys=2, rooms=2, stairs=True, glass=True)
COARSE = Lidar(azimuth_step=2.0)
NOISE_M = COARSE.noise


@pytest.fixture(scope="module")
def house() -> Building:
    return build(3, HOUSE)


@pytest.fixture(scope="module")
def walked(house: Building) -> RobotMap:
    return record(house, COARSE, Mapping(voxel=0, people=2, outliers=0.01, reflections=0.3), seed=3)


def volume(mesh: Mesh) -> float:
    """Volume inside a closed mesh, by the divergence theorem."""
    a, b, c = np.moveaxis(mesh.corners.astype(np.float64), 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def hits(mesh: Mesh, origins: F64, direction: tuple[float, float, float]) -> F64:
    """(N,) distances from origins (N, 3) to a mesh in a direction."""
    import open3d as o3d

    rays = np.concatenate([origins, np.broadcast_to(direction, origins.shape)], axis=1).astype(np.float32)
    return np.asarray(caster(mesh).cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy(), np.float64)


def test_the_same_seed_gives_the_same_building_and_map_and_another_seed_another(tmp_path: Path) -> None:
    style, written = Style(rooms=1), []
    for i, seed in enumerate((5, 5, 6)):
        building = build(seed, style)
        write(tmp_path / str(i), building, record(building, COARSE, seed=seed), COARSE, {})
        files = sorted(p for p in (tmp_path / str(i)).rglob("*") if p.is_file())
        written.append({p.relative_to(tmp_path / str(i)): p.read_bytes() for p in files})
    assert written[0] == written[1]
    assert all(written[0][name] != written[2][name] for name in written[0])


@pytest.mark.parametrize("seed", range(4))
def test_the_surface_is_closed_and_faces_the_air(seed: int) -> None:
    building = build(seed, HOUSE)
    cuts, cells = building.blocks
    size = np.einsum("i,j,k->ijk", *(np.diff(c) for c in cuts))
    opaque = building.mesh.keep(~np.isin(building.surface, (Surface.GLASS, Surface.FURNITURE)))
    assert volume(opaque) == pytest.approx(size[(cells > 0) & (cells != Surface.GLASS)].sum(), rel=1e-4)
    up = building.mesh.face_normal[:, 2]
    assert (up[building.surface == Surface.FLOOR] > 0.99).all()
    assert (up[building.surface == Surface.CEILING] < -0.99).all()
    assert np.abs(up[building.surface == Surface.PILLAR]).max(initial=0) < 0.01


def test_every_room_has_a_door_to_the_corridor_and_storeys_are_joined_by_stairs(house: Building) -> None:
    assert len(house.rooms) == 8 and len(house.doors) == 8
    for k, floor in enumerate(house.floors):
        free = house.free_space(k)
        doors = house.doors[np.isclose(house.doors[:, 0, 2], floor)].mean(axis=1)
        assert len(doors) == 4 and free.at(doors[:, :2]).all()
    heights = house.routes[0][:, 2]
    assert heights.min() == house.floors[0] and heights.max() == house.floors[1]
    steps = house.only(Surface.STAIRS)
    rises = np.unique(np.round(steps.vertices[steps.faces[steps.face_normal[:, 2] > 0.9]][..., 2], 3))
    assert np.allclose(np.diff(rises), np.diff(rises)[0], atol=2e-3) and 0.15 < np.diff(rises)[0] < 0.19


def test_stairs_need_two_storeys() -> None:
    with pytest.raises(SettingError, match="storeys"):
        build(0, Style(stairs=True))


@pytest.mark.parametrize("storey", (0, 1))
def test_free_space_is_free_and_has_a_floor(house: Building, storey: int) -> None:
    free, rng = house.free_space(storey, high=0.6), np.random.default_rng(0)
    rows, columns = np.nonzero(free.free)
    some = rng.choice(len(rows), 3000, replace=False)
    xy = free.origin + (np.column_stack([columns, rows])[some] + 0.5) * free.cell
    start = np.column_stack([xy, np.full(len(xy), free.floor + 0.6)])
    assert free.at(xy).all()
    down = hits(house.mesh, start, (0, 0, -1))
    assert np.abs(down - 0.6).max() < 0.051  # boards lower than 5 cm may lie on the floor
    assert np.isclose(down, 0.6, atol=1e-3).mean() > 0.98


def test_objects_on_the_floor_are_not_free(house: Building) -> None:
    free = house.free_space(0, high=0.6)
    for item in house.items:
        solid = item.boxes[(item.boxes[:, 0, 2] < 0.6) & (item.boxes[:, 1, 2] > 0.05)]
        middle = solid.mean(axis=1)[:, :2]
        c, s = np.cos(item.heading), np.sin(item.heading)
        if item.storey == 0:
            assert not free.at(middle @ np.array([[c, s], [-s, c]]) + item.xy).any(), item.kind
    assert not free.at(house.windows[:, :, :2].mean(axis=1)).any()


@pytest.mark.parametrize("seed", range(4))
def test_routes_are_clear_for_a_robot_of_half_a_metre(seed: int) -> None:
    building = build(seed, HOUSE)
    motion = drive(building.routes)
    xyz, _ = motion.at(np.arange(motion.times[0], motion.times[-1], 0.1))
    steps = building.only(Surface.STAIRS)
    away = (xyz[:, 0] < steps.vertices[:, 0].min() - 0.5) | (xyz[:, 0] > steps.vertices[:, 0].max() + 0.5)
    for k, floor in enumerate(building.floors):
        on = away & np.isclose(xyz[:, 2], floor)
        assert on.sum() > 200
        assert building.free_space(k, clearance=0.25, high=0.6).at(xyz[on, :2]).all()


def test_labels_of_points_agree_with_the_true_surface(house: Building, walked: RobotMap) -> None:
    import open3d as o3d

    returns = walked.returns
    still = ~np.isin(returns.surface, (Surface.PERSON, Surface.OUTLIER, Surface.REFLECTION))
    exact = o3d.core.Tensor(returns.exact[still].astype(np.float32))
    nearest = caster(house.mesh).compute_closest_points(exact)
    assert np.linalg.norm(nearest["points"].numpy() - returns.exact[still], axis=1).max() < 5e-3
    assert (house.surface[nearest["primitive_ids"].numpy()] == returns.surface[still]).mean() > 0.998  # except at edges
    assert (house.surface[returns.face[still]] == returns.surface[still]).all()
    assert set(np.unique(returns.surface)) >= {Surface.FLOOR, Surface.WALL, Surface.CEILING, Surface.STAIRS}
    codes = present(house.mesh.classification)[returns.face[still]]
    assert (codes == [LAS_CODE[Surface(k)] for k in returns.surface[still]]).all()


def test_range_noise_has_the_given_deviation_along_the_beam(walked: RobotMap) -> None:
    returns = walked.returns
    kept = returns.surface != Surface.OUTLIER
    off, beam = (returns.xyz - returns.exact)[kept], (returns.exact - returns.origin)[kept]
    beam /= np.linalg.norm(beam, axis=1, keepdims=True)
    along = np.einsum("ij,ij->i", off, beam)
    assert along.std() == pytest.approx(NOISE_M, rel=0.02)
    assert abs(along.mean()) < 0.002
    assert np.abs(off - along[:, None] * beam).max() < 1e-6


def test_only_opaque_panes_give_returns(walked: RobotMap) -> None:
    assert not np.isin(walked.surface, (Surface.GLASS, Surface.WINDOW)).any()
    opaque = record(build(3, Style(rooms=1)), COARSE, Mapping(voxel=0))
    assert (opaque.surface == Surface.WINDOW).mean() > 0.01


def test_people_outliers_and_reflections_are_labelled(house: Building, walked: RobotMap) -> None:
    xyz, surface = walked.world, walked.surface
    assert (surface == Surface.OUTLIER).mean() == pytest.approx(0.01, rel=0.01)
    person = xyz[surface == Surface.PERSON]
    assert 100 < len(person) < 0.3 * len(xyz)
    assert (person[:, 2] > -0.3).all() and (person[:, 2] < house.floors[1] + 2.1).all()
    mirrored = (surface == Surface.REFLECTION) & (np.abs(walked.returns.origin[:, 2] - COARSE.height) < 1e-6)
    assert mirrored.sum() > 100
    assert (walked.returns.exact[mirrored, 2] < 1e-3).all()
    plain = record(house, COARSE, Mapping(voxel=0), seed=3)
    assert not np.isin(plain.surface, (Surface.PERSON, Surface.OUTLIER, Surface.REFLECTION)).any()


@pytest.mark.parametrize("axes", AXES)
def test_a_map_in_any_frame_is_the_same_building(axes: str) -> None:
    building = build(4, Style(rooms=1))
    lidar = Lidar(azimuth_step=4.0, pitch=8.0, roll=-3.0, height=0.8)
    there = record(building, lidar, Mapping(voxel=0, axes=axes, start=random_rotation(4), unit=0.001), seed=4)
    assert np.abs(there.world - there.returns.xyz).max() < 1e-6
    assert np.abs(there.trajectory.positions[0]).max() < 1e-6
    height = there.trajectory.positions @ there.up * 0.001
    assert np.abs(height).max() < 1e-6  # on one level
    floor = (there.xyz[there.surface == Surface.FLOOR] @ there.up) * 0.001
    assert np.median(floor) == pytest.approx(-0.8, abs=0.01)


def test_loam_axes_are_left_up_forward() -> None:
    assert np.allclose(AXES["loam"] @ [1, 0, 0], [0, 0, 1])  # forward
    assert np.allclose(AXES["loam"] @ [0, 0, 1], [0, 1, 0])  # up
    assert all(np.isclose(np.linalg.det(m), 1.0) for m in AXES.values())


def test_thinned_maps_have_a_point_per_voxel(house: Building) -> None:
    from scipy.spatial import cKDTree

    thin = record(house, COARSE, Mapping(voxel=0.2), seed=3)
    voxels = np.floor(thin.xyz / 0.2 + [0, 0, 0.5]).astype(int)
    assert len(np.unique(voxels, axis=0)) == pytest.approx(len(voxels), rel=0.01)
    assert len(thin.xyz) < 0.5 * len(thin.returns.xyz)
    assert cKDTree(thin.world).query(thin.returns.xyz[::97])[0].max() < 0.2 * 3**0.5


def test_maps_are_written_as_pcd_with_trajectory_and_truth(house: Building, walked: RobotMap, tmp_path: Path) -> None:
    write(tmp_path, house, walked, COARSE, {"seed": 3})
    cloud = clouds.read(tmp_path / "map.pcd", Frame())
    assert np.abs(cloud.xyz - walked.xyz).max() < 1e-4
    assert np.corrcoef(present(cloud.intensity), walked.intensity)[0, 1] > 0.99
    with np.load(tmp_path / "truth" / "points.npz") as points:
        assert (points["surface"] == walked.surface).all()
    assert len(Mesh.load(tmp_path / "truth" / "mesh.npz")) == len(house.mesh)
    with np.load(tmp_path / "truth" / "free_1.npz") as free:
        assert free["free"].any() and free["floor"] == pytest.approx(house.floors[1])
    from scan2sim.pipeline.io import trajectory

    path: Trajectory = trajectory.read(tmp_path / "trajectory.csv")
    assert np.abs(path.positions - walked.trajectory.positions).max() < 1e-3
