"""The synthetic drive: video frames agree with their ground truth poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.data_samples import gps, hills, paths
from scan2sim.data_samples.drive import DriveConditions, generate_drive, render_exposed_frame, row_poses
from scan2sim.data_samples.ground import HALF_ROAD_M
from scan2sim.data_samples.panorama import GAIN_RANGE, Panorama, PanoramaImage
from scan2sim.data_samples.photos import directions
from scan2sim.data_samples.planner import PLOT_DISTANCE_M
from scan2sim.data_samples.scene import srgb
from scan2sim.data_samples.town import Town, build
from scan2sim.data_samples.traffic import Traffic
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F64, Camera, Trajectory

H = 128
CAMERA = Camera("equirectangular", 2 * H, H)
PATH = paths.loop_path(width=70.0, depth=60.0, laps=1.2)


@pytest.fixture(scope="module")
def town() -> Town:
    return build(PATH, seed=3)


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return paths.drive(PATH, 10.0, 15.0, seed=3)


@pytest.fixture(scope="module")
def camera(town: Town, trajectory: Trajectory) -> Panorama:
    return Panorama(town, Traffic(PATH, trajectory, 3), H, seed=3, radius=90.0)


def linear_light(image: np.ndarray, gain: float) -> np.ndarray:
    """Linear light of 8-bit sRGB, compensated for exposure; NaN where clipped."""
    encoded = srgb(np.linspace(0, 1, 4096) ** 2)
    linear = np.interp(image, encoded, np.linspace(0, 1, 4096) ** 2) / gain
    return np.where(image > 250, np.nan, linear)


def project(points: F64, pose: F64) -> tuple[np.ndarray, F64]:
    """Integer pixels (N, 2) and distances (N,) of world points."""
    d = (points - pose[:3, 3]) @ pose[:3, :3]
    distance = np.linalg.norm(d, axis=1)
    u = (np.arctan2(d[:, 0], d[:, 2]) / (2 * np.pi) + 0.5) * 2 * H - 0.5
    v = (np.arcsin(d[:, 1] / distance) / np.pi + 0.5) * H - 0.5
    return np.stack([np.round(u).astype(int) % (2 * H), np.clip(np.round(v).astype(int), 0, H - 1)], axis=1), distance


def static_points(image: PanoramaImage, poses: F64) -> tuple[np.ndarray, F64]:
    """Pixels (N, 2) that show static objects nearer than 40 m, and the points (N, 3) that they show."""
    static = np.isfinite(image.depth) & ~image.moving & (image.depth < 40)
    v, u = np.nonzero(static)
    rays = directions(CAMERA, np.stack([u, v], axis=1)) * image.depth[static][:, None]
    rows = np.broadcast_to(poses, (H, 4, 4))[v]
    return np.stack([u, v], axis=1), np.einsum("nij,nj->ni", rows[:, :3, :3], rays) + rows[:, :3, 3]


def photo_consistency(a: PanoramaImage, poses_a: F64, b: PanoramaImage, poses_b: F64) -> tuple[float, float]:
    """Share of a's static points that are visible in b, and their median relative difference in linear light."""
    pixels, points = static_points(a, poses_a)
    if poses_b.ndim == 2:
        projected, distance = project(points, poses_b)
    else:  # rolling shutter, each row has its own pose: find a point's row iteratively
        projected, distance = project(points, poses_b[H // 2])
        for _ in range(3):
            found = [project(points[i : i + 1], poses_b[projected[i, 1]]) for i in range(len(points))]
            projected, distance = np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])
    u, v = projected.T
    visible = np.abs(b.depth[v, u] - distance) < 0.05 * distance
    light_a = linear_light(a.rgb, a.gain)[pixels[visible, 1], pixels[visible, 0]]
    light_b = linear_light(b.rgb, b.gain)[v[visible], u[visible]]
    return float(visible.mean()), float(np.nanmedian(np.abs(light_a - light_b) / (light_a + light_b + 0.02)))


@pytest.mark.parametrize("file", ["town", "kitti"])
def test_a_drive_is_smooth_and_starts_from_rest(tmp_path: Path, file: str) -> None:
    if file == "kitti":
        angle = np.linspace(0, 3, 400)
        rows = np.tile(np.eye(4)[:3].ravel(), (400, 1))
        rows[:, 3], rows[:, 11] = 50 * (1 - np.cos(angle)), 50 * np.sin(angle)
        np.savetxt(tmp_path / "00.txt", rows)
        path = paths.kitti_path(tmp_path / "00.txt", 120.0)
        assert abs(paths.chainage(path)[-1] - 120) < 1
    else:
        path = paths.town_path(5, 400.0)
    drive = paths.drive(path, 12.0, 15.0)
    assert drive.rotations is not None
    v = np.diff(drive.positions, axis=0) * 15
    assert np.allclose(drive.positions[:15], drive.positions[0])  # the first second
    assert np.linalg.norm(v, axis=1).max() < 12.2
    assert np.linalg.norm(np.diff(v[:, :2], axis=0) * 15, axis=1).max() < 4.5
    assert np.allclose(drive.rotations @ drive.rotations.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    moving = np.linalg.norm(v, axis=1) > 1
    cosine = np.einsum("ij,ij->i", v, drive.rotations[:-1, :, 2])[moving] / np.linalg.norm(v, axis=1)[moving]
    assert cosine.min() > 0.97  # the car faces its direction of motion
    assert drive.rotations[:, 2, 1].max() < -0.99  # y is down
    assert 0.002 < drive.positions[:, 2].std() < 0.06


def test_no_object_is_on_the_road(town: Town) -> None:
    houses = [t for t in town.placed if getattr(t.make, "func", t.make).__name__ == "house"]
    assert len(houses) > 10
    for t in houses:
        corners = t.make().moved(t.heading, (0, 0, 0)).vertices[:, :2] + t.at
        assert town.ground.at(corners).min() > PLOT_DISTANCE_M - 0.6
    assert min(float(town.ground.at(t.at)) for t in town.placed) > HALF_ROAD_M - 1.5
    from scipy.spatial import cKDTree

    assert cKDTree(town.ground.driven).query(np.array([t.at for t in town.placed]))[0].min() > 2.0


@pytest.mark.slow
def test_frames_are_consistent_under_their_poses(camera: Panorama, trajectory: Trajectory) -> None:
    for i, j in ((60, 63), (150, 147)):
        a, b = (camera.render(trajectory.poses[k], float(trajectory.times[k])) for k in (i, j))
        share, difference = photo_consistency(a, trajectory.poses[i], b, trajectory.poses[j])
        assert share > 0.8
        assert difference < 0.06
        _, wrong = photo_consistency(a, trajectory.poses[i], b, trajectory.poses[j + 3])
        assert wrong > 1.5 * difference  # the measure detects a wrong pose


@pytest.mark.slow
def test_rows_of_a_rolling_shutter_have_their_own_poses(camera: Panorama, trajectory: Trajectory) -> None:
    time = float(trajectory.times[70])
    poses = row_poses(trajectory, time, H, 0.06)
    rolling = camera.render(poses, time)
    for row in (30, 64, 100):
        whole = camera.render(poses[row], time)
        assert np.array_equal(rolling.depth[row], whole.depth[row])
    still = camera.render(trajectory.poses[70], time)
    assert np.nanmedian(np.abs(still.depth[100] - rolling.depth[100])) > 0.001
    assert np.allclose(row_poses(trajectory, time, H, 0.0)[5], trajectory.poses[70], atol=1e-9)
    share, difference = photo_consistency(still, trajectory.poses[70], rolling, poses)
    assert share > 0.8
    assert difference < 0.06


def render(town: Town, poses: F64, time: float, lens: float = 0.0) -> PanoramaImage:
    return Panorama(town, None, H, seed=3, radius=90.0, lens=lens).render(poses, time)


def test_hills_raise_the_scene_and_tilt_the_car(trajectory: Trajectory) -> None:
    waves = hills.draw(PATH, 0.08, 3)
    driven = hills.lifted(trajectory, waves)
    assert driven.rotations is not None
    move = np.diff(driven.positions[20:-20], axis=0)
    climb = np.diff(hills.heights(driven.positions[20:-20, :2], waves)) / np.linalg.norm(move[:, :2], axis=1)
    assert 0.06 < np.abs(climb).max() < 0.085
    ahead = driven.rotations[20:-21, :, 2]
    assert np.abs(ahead[:, 2] - climb).max() < 0.03  # the rest is suspension motion
    steep = 20 + int(np.abs(climb).argmax())
    camera = Panorama(build(PATH, 3, hills=waves), None, H, seed=3, radius=90.0)
    for k in (steep, steep + 3):
        image = camera.render(driven.poses[k], k / 15)
        pixels, points = static_points(image, driven.poses[k])
        above = points[:, 2] - hills.heights(points[:, :2], waves)
        road = (camera.town.ground.at(points[:, :2]) < HALF_ROAD_M - 0.5) & (pixels[:, 1] > 0.6 * H)
        assert road.sum() > 500
        assert np.quantile(np.abs(above[road]), 0.8) < 0.01  # the other points are on parked cars
        assert above.min() > -0.05


def test_both_lenses_have_their_own_positions(town: Town, trajectory: Trajectory) -> None:
    pose, time = trajectory.poses[70], float(trajectory.times[70])
    both = render(town, pose, time, lens=0.5)
    for side in (1, -1):
        moved = pose.copy()
        moved[:3, 3] += side * 0.5 * pose[:3, 2]
        columns = slice(H // 2 + 2, 3 * H // 2 - 2) if side == 1 else slice(0, H // 2 - 2)
        single = render(town, moved, time)
        same = np.isclose(both.depth[:, columns], single.depth[:, columns], rtol=1e-3, equal_nan=True)
        assert same.mean() > 0.995


def test_motion_blur_keeps_the_mean_light(town: Town, trajectory: Trajectory) -> None:
    camera, i = Panorama(town, None, H, seed=3, samples=1, radius=90.0), 70
    sharp, blurred = (
        linear_light(render_exposed_frame(camera, trajectory, i, DriveConditions(exposure=s)), 1.0) for s in (0.0, 0.04)
    )
    rows, beside = slice(H * 2 // 5, H * 3 // 5), np.r_[H // 2 - 10 : H // 2 + 10, 3 * H // 2 - 10 : 3 * H // 2 + 10]
    edges = [np.nanmean(np.abs(np.diff(image[rows], axis=1))[:, beside]) for image in (sharp, blurred)]
    assert edges[1] < 0.9 * edges[0]
    assert np.nanmean(blurred[rows]) == pytest.approx(np.nanmean(sharp[rows]), rel=0.02)


def test_a_low_sun_overexposes_unless_a_house_hides_it(trajectory: Trajectory) -> None:
    camera = Panorama(build(PATH, 3, low_sun=True), None, H, seed=3, radius=90.0)
    assert np.degrees(np.arccos(camera.town.sun @ trajectory.poses[30, :3, 2])) < 25  # ahead, at first
    spots = []
    for k in range(15, 240, 15):
        image = camera.render(trajectory.poses[k], k / 15)
        to = camera.town.sun @ trajectory.poses[k, :3, :3]
        column, row = (np.arctan2(to[0], to[2]) / np.pi + 1) * H, (np.arcsin(to[1]) / np.pi + 0.5) * H
        spots.append(int(image.rgb[int(row), int(column) % (2 * H)].min()))
    assert max(spots) > 240 and min(spots) < 150


def test_panoramas_are_continuous_at_the_seam_and_mask_the_ego_vehicle(
    camera: Panorama, trajectory: Trajectory
) -> None:
    image = camera.render(trajectory.poses[90], 6.0)
    rgb = image.rgb.astype(int)
    seam = np.abs(rgb[:, 0] - rgb[:, -1]).mean()
    assert seam < 1.5 * np.abs(np.diff(rgb, axis=1)).mean() + 2
    ego_vehicle = camera.mask == 0
    assert 0.12 < ego_vehicle.mean() < 0.2
    assert not ego_vehicle[: H * 8 // 10].any()
    assert np.isnan(image.depth[ego_vehicle]).all()
    assert not np.isnan(image.depth[~ego_vehicle]).any()
    other = camera.render(trajectory.poses[140], 9.0)
    assert np.array_equal(image.rgb[ego_vehicle], other.rgb[ego_vehicle])


def test_exposure_changes_smoothly(camera: Panorama) -> None:
    gains = np.array([camera.gain(t) for t in np.arange(0, 120, 1 / 15)])
    assert GAIN_RANGE[0] <= gains.min() < 0.85
    assert 1.05 < gains.max() <= GAIN_RANGE[1]
    assert np.abs(np.diff(gains)).max() < 0.06


def test_the_same_seed_gives_the_same_image(town: Town, trajectory: Trajectory) -> None:
    def image(seed: int) -> np.ndarray:
        camera = Panorama(build(PATH, seed), Traffic(PATH, trajectory, seed), 64, seed, radius=45.0)
        return camera.render(trajectory.poses[100], float(trajectory.times[100])).rgb

    first = image(3)
    assert np.array_equal(first, image(3))
    assert np.abs(first.astype(int) - image(4)).mean() > 5


def test_other_cars_move(camera: Panorama, trajectory: Trajectory) -> None:
    assert camera.traffic is not None
    for time in (3.0, 7.0):
        now, later = camera.traffic.at(time), camera.traffic.at(time + 0.5)
        assert now
        before = {id(v): xy for v, xy, _ in now}
        moves = [np.linalg.norm(xy - before[id(v)]) for v, xy, _ in later if id(v) in before]
        assert max(moves) > 1.0
        pose = trajectory.poses[round(time * 15)]
        for v, xy, _ in now:
            offset = pose[:2, 3] - xy
            assert np.linalg.norm(offset) > 2.5, v
    assert any(camera.render(trajectory.poses[k], k / 15).moving.any() for k in range(30, 180, 30))


def test_buses_can_block_the_view(town: Town, trajectory: Trajectory) -> None:
    camera = Panorama(town, Traffic(PATH, trajectory, 3, bus=(6.0, 8.0)), H, seed=3, radius=60.0)
    rows = slice(H * 2 // 5, H // 2)  # from the horizon to 18 degrees above it
    shares = [camera.render(trajectory.poses[k], k / 15).moving[rows].mean() for k in (60, 105)]
    assert shares[0] < 0.3
    assert shares[1] > 0.95


def test_gps_errors_have_the_specified_noise_gaps_and_jumps() -> None:
    n = 40_000
    still = Trajectory(np.arange(n, dtype=float), np.zeros((n, 3)))
    times, xyz = gps.receiver(still, 1.0, seed=1)
    assert len(times) == n
    assert np.allclose(xyz.std(axis=0), [1.5, 1.5, 2.5], rtol=0.15)
    x = xyz[:, 0] - xyz[:, 0].mean()
    assert 0.25 < (x[60:] * x[:-60]).mean() / x.var() < 0.5  # 1/e after a minute
    assert np.diff(xyz[:, 0]).std() < 0.6
    gapped, moved = gps.receiver(still, 1.0, 1, gaps=[(100.0, 200.0)], jumps=[(500.0, 20.0), (600.0, 0.0)])
    assert len(gapped) == n - 100
    jump = moved - xyz[np.isin(times, gapped)]
    inside = (gapped >= 500) & (gapped < 600)
    assert np.allclose(np.linalg.norm(jump[inside], axis=1), 20)
    assert np.allclose(jump[~inside], 0)
    assert len(gps.receiver(still, 5.0)[0]) == 5 * (n - 1) + 1


def test_geographic_coordinates_agree_with_metres() -> None:
    lat, lon, up = gps.geographic(np.array([[0, 0, 0], [0, 100, 0], [100, 0, 5.0]])).T
    assert np.allclose([lat[0], lon[0], up[0]], gps.ORIGIN)
    assert abs((lat[1] - lat[0]) * 111_220 - 100) < 0.5
    assert abs((lon[2] - lon[0]) * 111_320 * np.cos(np.radians(49.2)) - 100) < 1.0
    assert abs(up[2] - up[0] - 5) < 0.01


def test_a_drive_writes_video_truth_gps_and_mask(tmp_path: Path) -> None:
    import av
    import cv2

    out = generate_drive(
        tmp_path / "drive", PATH, seconds=1.2, height=64, fps=12.5, bitrate=5e5, seed=3, gps_rate=5.0, lossless=True
    )
    with av.open(str(out / "video.mp4")) as video:
        frames = [(f.time, f.to_ndarray(format="rgb24")) for f in video.decode(video=0)]
    assert len(frames) == 15
    assert np.allclose([t for t, _ in frames], np.arange(15) / 12.5, atol=1e-6)
    kept = sorted((out / "frames").glob("*.png"))
    assert len(kept) == 15
    assert np.abs(cv2.imread(str(kept[7]))[..., ::-1].astype(int) - frames[7][1]).mean() < 8
    truth = np.loadtxt(out / "truth.csv", delimiter=",", skiprows=1)
    assert (out / "truth.csv").read_text(encoding="utf-8").startswith("time,x,y,z,qx,qy,qz,qw\n")
    assert truth.shape == (15, 8)
    assert np.allclose(truth[:, 0], [t for t, _ in frames], atol=1e-6)
    assert np.allclose(np.linalg.norm(truth[:, 4:], axis=1), 1)
    fixes = np.loadtxt(out / "gps.csv", delimiter=",", skiprows=1)
    assert fixes.shape == (6, 4)
    assert np.abs(fixes[:, 1] - 49.2).max() < 0.01
    mask = cv2.imread(str(out / "mask.png"), cv2.IMREAD_UNCHANGED)
    assert mask.shape == (64, 128)
    assert set(np.unique(mask)) == {0, 255}
    assert sorted(p.name for p in out.iterdir()) == [
        "camera.json",
        "frames",
        "gps.csv",
        "mask.png",
        "truth.csv",
        "video.mp4",
    ]
    with pytest.raises(SettingError):
        generate_drive(out, PATH, seconds=1.0, height=64)


def test_an_interrupted_drive_resumes_with_the_frames_that_it_has(tmp_path: Path) -> None:
    import cv2

    def render(stop_at: float = 2.0, resume: bool = True) -> None:
        def report(fraction: float, message: str = "") -> None:
            if fraction >= stop_at:
                raise KeyboardInterrupt

        generate_drive(
            tmp_path, PATH, seconds=0.6, height=64, fps=10, seed=3, lossless=True, resume=resume, overwrite=True,
            report=report,
        )  # fmt: skip

    with pytest.raises(KeyboardInterrupt):
        render(stop_at=0.5)
    frames = [tmp_path / "frames" / f"{i:06d}.png" for i in range(6)]
    assert [file.is_file() for file in frames] == [True] * 3 + [False] * 3 and not (tmp_path / "video.mp4").exists()
    cv2.imwrite(str(frames[0]), np.full((64, 128, 3), 77, np.uint8))
    render()
    assert (cv2.imread(str(frames[0])) == 77).all() and all(file.is_file() for file in frames)
    assert (tmp_path / "video.mp4").is_file()
    render(resume=False)
    assert not (cv2.imread(str(frames[0])) == 77).all(), "rendered again"
