"""Corner tracking on the sphere, including seam and poles."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_rays, project
from scan2sim.pipeline.core.types import F32, F64, U8, Camera
from scan2sim.slam.geometry import exp_so3, relative_pose, rigid
from scan2sim.slam.optical_flow import exposure
from scan2sim.slam.trackers.corners import FINE_WINDOW_PX, CornerTracker, flow
from scan2sim.slam.virtual_cameras import VirtualViews

CAMERA = Camera("equirectangular", 768, 384)


def sphere(seed: int = 0) -> Callable[[F64], F32]:
    """Texture as a function of direction, with equal statistics in all directions."""
    import cv2
    from scipy.ndimage import map_coordinates

    rng = np.random.default_rng(seed)
    faces = [cv2.GaussianBlur(rng.integers(0, 255, (400, 400), np.uint8), (0, 0), 2.0) for _ in range(6)]
    faces = [cv2.normalize(f, None, 0, 255, cv2.NORM_MINMAX) for f in faces]

    def frame_of(rays: F64) -> F32:
        axis = np.abs(rays).argmax(axis=-1)
        out = np.zeros(rays.shape[:-1], np.float32)
        for k in range(3):
            for s, sign in enumerate((1, -1)):
                at = (axis == k) & (np.sign(rays[..., k]) == sign)
                a, b = (rays[at][:, (k + j) % 3] / np.abs(rays[at][:, k]) for j in (1, 2))
                out[at] = map_coordinates(faces[2 * k + s].astype(np.float32), (np.stack([a, b]) + 1) * 199.5, order=1)
        return out

    return frame_of


def frame(world: Callable[[F64], F32], R: F64) -> U8:
    """Image of an equirectangular camera with rotation R (camera to world)."""
    return world(pixel_rays(CAMERA).astype(np.float64) @ R.T).astype(np.uint8)


def test_pixels_and_bearings_of_virtual_views_round_trip() -> None:
    views, rng = VirtualViews(CAMERA), np.random.default_rng(0)
    bearing = rng.normal(size=(3000, 3))
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    view = views.view_of(bearing)
    assert set(view) == {0, 1, 2}
    for k in range(3):
        mine = bearing[view == k]
        assert np.abs(views.bearings(k, views.pixels(k, mine)) - mine).max() < 1e-5


@pytest.mark.parametrize("axis", [[0, 1, 0], [1, 0, 0], [0, 0, 1]])
def test_corners_are_tracked_across_seam_and_poles(axis: list[int]) -> None:
    world, views = sphere(), VirtualViews(CAMERA)
    tracker = CornerTracker(views, None, 500)
    tracker.track(frame(world, np.eye(3)))
    tracker.refill()
    first = tracker.tracks
    steps = 8
    for k in range(1, steps + 1):
        tracker.track(frame(world, exp_so3(np.array(axis) * 0.06 * k)))
    R = exp_so3(np.array(axis) * 0.06 * steps)
    at = np.searchsorted(first.ids, tracker.tracks.ids)
    assert len(at) > 0.6 * len(first)
    off = np.degrees(np.arccos(np.clip((first.bearing[at] @ R * tracker.tracks.bearing).sum(axis=1), -1, 1)))
    assert np.median(off) < 0.2  # a pixel is 0.47
    azimuth = np.arctan2(first.bearing[at, 0], first.bearing[at, 2])
    now = np.arctan2(tracker.tracks.bearing[:, 0], tracker.tracks.bearing[:, 2])
    if axis == [0, 1, 0]:
        crossed = np.abs(azimuth - now) > np.pi
        assert crossed.sum() > 10 and np.median(off[crossed]) < 0.2
    else:
        polar = np.abs(tracker.tracks.bearing[:, 1]) > 0.95
        assert polar.sum() > 5 and np.median(off[polar]) < 0.25


@pytest.mark.parametrize(("gain", "offset"), [(0.45, 0), (0.6, 30), (1.3, -20)])
def test_exposure_change_is_estimated_and_no_corner_lost(gain: float, offset: float) -> None:
    world, views = sphere(), VirtualViews(CAMERA)
    pictures = [frame(world, exp_so3([0, 0.04 * k, 0])) // 2 + 60 for k in range(2)]
    lit = np.clip(gain * pictures[1].astype(np.float64) + offset, 0, 255).astype(np.uint8)
    followed = []
    for second in (pictures[1], lit):
        tracker = CornerTracker(views, None, 500)
        tracker.track(pictures[0])
        tracker.refill()
        there = views.pixels(0, tracker.tracks.bearing)
        now = views.pixels(0, tracker.tracks.bearing @ exp_so3([0, 0.04, 0]))
        first = tracker.images[0]
        tracker.track(second)
        followed.append(len(tracker.tracks))
    estimated = exposure.estimate(first, tracker.images[0], there, now)
    assert estimated.gain == pytest.approx(gain, rel=0.03) and estimated.offset == pytest.approx(offset, abs=4)
    assert followed[1] > 0.95 * followed[0]


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 12), (0.9, 0), (1.1, 0)])
def test_wrong_exposure_estimate_does_not_shift_corners(gain: float, offset: float) -> None:
    first = frame(sphere(), np.eye(3))
    second = np.clip(gain * (first.astype(np.float64) // 2 + 60) + offset, 0, 255).astype(np.uint8)
    first = first // 2 + 60
    start = cv2.goodFeaturesToTrack(first, 200, 0.01, 12).reshape(-1, 2)

    def off(old: np.ndarray, new: np.ndarray) -> float:
        there, found, _ = flow(old, new, start, start.copy(), FINE_WINDOW_PX, 1)
        return float(np.median(np.linalg.norm(there - start, axis=1)[found.ravel() > 0]))

    assert off(exposure.subtract_local_mean(first), exposure.subtract_local_mean(second)) < 0.3 * off(first, second)


def test_no_features_on_the_masked_ego_vehicle() -> None:
    world, views = sphere(), VirtualViews(CAMERA)
    mask = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    mask[300:] = 0
    tracker = CornerTracker(views, mask, 500)
    for k in range(3):
        tracker.track(frame(world, exp_so3([0, 0.05 * k, 0])))
        tracker.refill()
    uv, _ = project(CAMERA, tracker.tracks.bearing)
    assert len(uv) > 100 and uv[:, 1].max() < 302


def test_corners_are_evenly_distributed_over_the_sphere() -> None:
    tracker = CornerTracker(VirtualViews(CAMERA), None, 400)
    tracker.track(frame(sphere(), np.eye(3)))
    tracker.refill()
    octant = (tracker.tracks.bearing > 0) @ [1, 2, 4]
    counts = np.bincount(octant, minlength=8)
    assert counts.min() > 0.4 * counts.mean()


def test_relative_pose_is_estimated_in_spite_of_outliers() -> None:
    rng = np.random.default_rng(0)
    T = rigid(exp_so3([0.02, 0.3, -0.05]), np.array([0.6, 0.0, 0.8]))
    xyz = rng.normal(0, 8, (300, 3))
    a, b = xyz, (xyz - T[:3, 3]) @ T[:3, :3]
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b))
    b[:90] = np.roll(b[:90], 1, axis=0)
    found = relative_pose(a, b, threshold=np.radians(0.2), rng=rng)
    assert found is not None and np.abs(found[0] - T).max() < 1e-3
    assert found[1][90:].mean() > 0.95 and found[1][:90].mean() < 0.2
    assert relative_pose(a, rng.permutation(b), threshold=np.radians(0.2), rng=rng) is None


def test_corners_do_not_drift_in_rotating_images() -> None:
    """Tracked only from frame to frame, corners near a pole drift by .3 degrees while the car turns by 30."""
    world, views = sphere(), VirtualViews(CAMERA)
    tracker = CornerTracker(views, None, 500)
    tracker.track(frame(world, np.eye(3)))
    tracker.refill()
    first = tracker.tracks
    for k in range(1, 21):
        R = exp_so3(np.array([0, 1, 0]) * np.radians(1.5) * k)
        tracker.track(frame(world, R))
    at = np.searchsorted(first.ids, tracker.tracks.ids)
    off = np.degrees(np.arccos(np.clip((first.bearing[at] @ R * tracker.tracks.bearing).sum(axis=1), -1, 1)))
    cap = np.abs(tracker.tracks.bearing[:, 1]) > np.sin(np.radians(50))
    assert len(at) > 0.6 * len(first)
    assert np.median(off) < 0.1 and np.median(off[cap]) < 0.1  # a pixel is 0.47
