"""The synthetic street is a valid tile with correct ground truth."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from scan2sim.data_samples import photos as photo_module
from scan2sim.data_samples.layout import FRAME, Style, lay_out
from scan2sim.data_samples.photos import Effects, directions
from scan2sim.data_samples.scanner import plan_drive, scan
from scan2sim.data_samples.scene import Scene
from scan2sim.data_samples.street import generate
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import Camera, Mesh, PointCloud, Tile
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.tile import read_tile

LENGTH_M, POINTS, PHOTOS, PHOTO_WIDTH_PX = 10.0, 20_000, 4, 320


@dataclass(frozen=True)
class Street:
    """A generated street, read from its files."""

    tile: Tile
    cloud: PointCloud
    truth: PointCloud
    mesh: Mesh


def _generate(out: Path, seed: int) -> Path:
    return generate(
        out,
        length=LENGTH_M,
        points=POINTS,
        photos=PHOTOS,
        seed=seed,
        photo_width=PHOTO_WIDTH_PX,
        truth_density=25,
        photo_labels=True,
    )


def _digests(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Street:
    tile = read_tile(_generate(tmp_path_factory.mktemp("street"), 3))
    assert tile.truth_mesh is not None and tile.truth_points is not None
    truth = clouds.read(tile.truth_points, FRAME)
    return Street(tile, clouds.read(tile.clouds[0], FRAME), truth, Mesh.load(tile.truth_mesh))


def test_the_street_is_a_tile_in_a_projected_crs(street: Street) -> None:
    assert street.tile.frame.crs == "EPSG:32633"
    assert min(street.tile.frame.origin[:2]) > 100_000
    assert street.tile.trajectory is not None
    times = street.tile.trajectory.times
    assert (np.diff(times) > 0).all()
    assert street.cloud.time is not None
    assert street.cloud.time.min() >= times[0] and street.cloud.time.max() <= times[-1]
    assert {v.camera.model for v in street.tile.views} == {"opencv", "pinhole", "equirectangular"}


def test_the_cloud_has_the_requested_number_of_points(street: Street) -> None:
    assert len(street.cloud) == pytest.approx(POINTS, rel=0.01)


def test_the_same_seed_gives_identical_files_and_another_seed_another_street(street: Street, tmp_path: Path) -> None:
    first = _digests(street.tile.path.parent)
    assert _digests(_generate(tmp_path / "same", 3).parent) == first
    other = _digests(_generate(tmp_path / "other", 4).parent)
    assert {name for name in first if other.get(name) == first[name]} <= {"trajectory.csv"}


def test_points_lie_on_the_true_surface_and_have_its_label(street: Street) -> None:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(street.mesh.vertices), o3d.core.Tensor(street.mesh.faces.astype(np.uint32)))
    still = street.cloud.classification != CODE["vehicle"]
    nearest = scene.compute_closest_points(o3d.core.Tensor(street.cloud.xyz[still]))
    distance = np.linalg.norm(nearest["points"].numpy() - street.cloud.xyz[still], axis=1)
    assert np.quantile(distance, 0.99) < 0.03  # range noise of 1 cm
    assert street.mesh.classification is not None and street.cloud.classification is not None
    same = street.mesh.classification[nearest["primitive_ids"].numpy()] == street.cloud.classification[still]
    assert same.mean() > 0.97


def test_photos_show_the_true_colours(street: Street) -> None:
    """Ground truth points visible in a photo agree with its pixels after exposure compensation."""
    import cv2
    import open3d as o3d

    scene = Scene(lay_out(LENGTH_M, 3))
    folder = street.tile.path.parent
    everything = o3d.t.geometry.RaycastingScene()
    street_faces = scene.surface.faces[: scene._first_face[0]].astype(np.uint32)
    everything.add_triangles(o3d.core.Tensor(scene.surface.vertices), o3d.core.Tensor(street_faces))
    lines = (folder / "truth/exposures.csv").read_text(encoding="utf-8").splitlines()[1:]
    ev = dict(line.split(",") for line in lines)
    offset = street.tile.frame.to_local(FRAME.to_crs(street.truth.xyz))
    assert street.truth.rgb is not None
    for view in street.tile.views:
        uv, ahead = _project(view.camera, (offset - view.centre) @ view.T_world_cam[:3, :3])
        inside = ahead & (uv > 2).all(axis=1) & (uv < [view.camera.width - 3, view.camera.height - 3]).all(axis=1)
        centre = FRAME.to_local(street.tile.frame.to_crs(view.centre))
        ray = street.truth.xyz[inside] - centre
        length = np.linalg.norm(ray, axis=1)
        rays = np.concatenate([np.broadcast_to(centre, ray.shape), ray / length[:, None]], axis=1).astype(np.float32)
        hit = everything.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        codes = cv2.imread(str(folder / "truth/labels" / f"{Path(view.name).name}.png"), cv2.IMREAD_UNCHANGED)
        assert codes.shape == (view.camera.height, view.camera.width)
        at = np.rint(uv[inside]).astype(int)
        seen = (np.abs(hit - length) < 0.01) & (codes[at[:, 1], at[:, 0]] != CODE["vehicle"]) & (length < 12)
        photo = cv2.imread(str(view.photo))[..., ::-1].astype(np.float64)[at[seen, 1], at[seen, 0]] / 255
        gain = 2.0 ** float(ev[f"{view.name}.jpg"])
        expected = np.clip(_linear(street.truth.rgb[inside][seen] / 255) * gain, 0, 1)
        difference = np.abs(photo - _encoded(expected)).mean(axis=1)
        assert seen.sum() > 200
        assert np.median(difference) < 0.05, view.name
        bias = (photo - _encoded(expected)).mean()
        assert abs(bias) < 0.02, view.name


@pytest.fixture(scope="module")
def long_street() -> tuple[Scene, PointCloud]:
    scene = Scene(lay_out(40.0, 0))
    return scene, scan(scene, plan_drive(scene.layout, 60_000), 60_000)


def test_a_long_street_contains_all_classes(long_street: tuple[Scene, PointCloud]) -> None:
    scene, cloud = long_street
    mesh = scene.truth_mesh()
    assert cloud.classification is not None and mesh.classification is not None and cloud.time is not None
    assert set(np.unique(cloud.classification)) == {2, 3, 5, 6, 11, 64, 65, 66, 68, 69}
    assert set(np.unique(mesh.classification)) == {2, 3, 5, 6, 11, 64, 65, 68, 69}  # worlds contain no vehicles
    assert len(mesh) < 6000 * 40


def test_the_moving_car_leaves_a_trail_of_points(long_street: tuple[Scene, PointCloud]) -> None:
    scene, cloud = long_street
    assert cloud.classification is not None and cloud.time is not None
    layout = scene.layout
    s, t = layout.axis.locate(cloud.xyz[cloud.classification == CODE["vehicle"], :2].astype(np.float64))
    in_lane = np.abs(t) < layout.lane - 0.3  # parked cars are beside the lanes
    time = cloud.time[cloud.classification == CODE["vehicle"]][in_lane]
    assert np.ptp(s[in_lane]) > 12 and np.ptp(time) > 1


def test_the_moving_car_can_be_omitted(long_street: tuple[Scene, PointCloud]) -> None:
    scene, cloud = long_street
    without = Scene(lay_out(40.0, 0, Style(moving_car=False)))
    np.testing.assert_array_equal(without.truth_mesh().vertices, scene.truth_mesh().vertices)
    still = scan(without, plan_drive(without.layout, 60_000), 60_000)

    def in_lanes(points: PointCloud) -> int:
        assert points.classification is not None
        _, t = scene.layout.axis.locate(points.xyz[points.classification == CODE["vehicle"], :2].astype(np.float64))
        return int((np.abs(t) < scene.layout.lane - 0.3).sum())

    assert in_lanes(cloud) > 0 and in_lanes(still) == 0
    camera = photo_module.cameras(64)["pano"]
    drive = plan_drive(scene.layout, 60_000)
    shot = photo_module.plan_shots(scene.layout, drive, 32, 0.0)[13]
    with_car, bare, never = (
        photo_module.render(s, drive, camera, shot.T_world_cam, time).light
        for s, time in ((scene, shot.time), (scene, None), (without, shot.time))
    )
    assert (with_car != bare).any()
    np.testing.assert_array_equal(never, bare)


def test_facades_have_points_at_the_height_of_the_scanner(long_street: tuple[Scene, PointCloud]) -> None:
    scene, cloud = long_street
    s, _ = scene.layout.axis.locate(cloud.xyz[cloud.classification == CODE["building"], :2].astype(np.float64))
    above = cloud.xyz[cloud.classification == CODE["building"], 2] - scene.layout.height(s, 0.0)
    counts, _ = np.histogram(above, np.arange(1.0, 3.0, 0.1))
    assert counts.min() > 0.4 * np.median(counts)


@pytest.mark.parametrize(("length", "count"), [(100.0, 40), (40.0, 10), (12.0, 4)])
def test_photo_stations_are_at_most_5_m_apart(length: float, count: int) -> None:
    layout = lay_out(length, 1)
    shots = photo_module.plan_shots(layout, plan_drive(layout, 1e5), count, 0.3)
    chainage = np.unique([(s.time - shots[0].time) * 10 for s in shots])
    assert len(shots) == count
    assert {s.camera for s in shots} == set(photo_module.CAMERA_ORDER)
    assert np.diff(chainage).max() <= 5.0 + 1e-6 and chainage[-1] >= length - 5.0 - 1e-6
    assert all(abs(s.ev) <= 0.3 for s in shots)


@pytest.mark.parametrize("camera", photo_module.cameras(400).values(), ids=photo_module.CAMERA_ORDER)
def test_ray_directions_invert_the_projection(camera: Camera) -> None:
    pixels = np.random.default_rng(0).uniform([0, 0], [camera.width - 1, camera.height - 1], (200, 2))
    back, ahead = _project(camera, directions(camera, pixels) * 7.0)
    assert ahead.all()
    np.testing.assert_allclose(back, pixels, atol=1e-4)


def test_style_and_effects_change_houses_and_exposures() -> None:
    plain = lay_out(40.0, 5)
    bricks = lay_out(40.0, 5, Style(brick_share=1.0, flat_roof_share=1.0))
    assert {h.roof for h in bricks.houses} == {"flat"} and all(h.brick for h in bricks.houses)
    assert {h.roof for h in plain.houses} != {"flat"}
    shots = photo_module.plan_shots(plain, plan_drive(plain, 1e5), 40, Effects(exposure_ev=1.0).exposure_ev)
    assert 0.7 < max(abs(s.ev) for s in shots) <= 1.0


def test_locating_on_the_axis_inverts_placing() -> None:
    axis = lay_out(100.0, 2).axis
    s, t = np.meshgrid(np.linspace(0, 100, 11), np.linspace(-20, 20, 9))
    xy, _ = axis.place(s, t)
    found = axis.locate(xy)
    np.testing.assert_allclose(found[0], s, atol=1e-6)
    np.testing.assert_allclose(found[1], t, atol=1e-6)


def test_impossible_settings_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="length"):
        generate(tmp_path, length=2.0)


def _project(camera: Camera, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of points in camera coordinates, and whether they are in front of the camera."""
    x, y, z = xyz.T
    if camera.model == "equirectangular":
        lon, lat = np.arctan2(x, z), np.arcsin(y / np.linalg.norm(xyz, axis=1))
        uv = np.stack([(lon / (2 * np.pi) + 0.5) * camera.width, (lat / np.pi + 0.5) * camera.height], axis=1) - 0.5
        return uv, np.ones(len(xyz), bool)
    ahead = z > 0.3 * np.linalg.norm(xyz, axis=1)
    a, b = x / np.where(ahead, z, 1), y / np.where(ahead, z, 1)
    if camera.distortion:
        k1, k2, p1, p2 = camera.distortion
        r2 = a * a + b * b
        k = 1 + k1 * r2 + k2 * r2 * r2
        a, b = a * k + 2 * p1 * a * b + p2 * (r2 + 2 * a * a), b * k + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    return np.stack([camera.fx * a + camera.cx, camera.fy * b + camera.cy], axis=1), ahead


def _linear(x: np.ndarray) -> np.ndarray:
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def _encoded(x: np.ndarray) -> np.ndarray:
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
