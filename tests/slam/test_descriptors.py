"""Descriptor tracking: persistent ids, accurate bearings on the whole sphere, including seam and poles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_rays, project
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import F64, U8, Camera
from scan2sim.slam import features, matchers
from scan2sim.slam.features import FeatureSet
from scan2sim.slam.geometry import exp_so3
from scan2sim.slam.odometry.checkpoint import load, save
from scan2sim.slam.odometry.video_odometry import VALUES
from scan2sim.slam.trackers.descriptors import DescriptorTracker
from scan2sim.slam.virtual_cameras import VirtualViews

SPHERE = Camera("equirectangular", 512, 256)
NUMBER = 400


def noise_image(camera: Camera, R: F64, seed: int = 0) -> U8:
    """Grey image (H, W) of a camera with rotation R (3, 3) to the world, which is filled with noise."""
    from scipy.ndimage import map_coordinates

    rays = pixel_rays(camera).reshape(-1, 3) @ R.T
    rng = np.random.default_rng(seed)
    out = np.zeros(len(rays))
    for scale, weight in ((5, 1.0), (11, 1.0), (23, 0.8)):
        noise = rng.normal(size=(50, 50, 50))
        out += weight * np.tanh(3 * map_coordinates(noise, (rays * scale + 24.7).T, order=1, mode="wrap"))
    return np.clip(128 + 45 * out, 0, 255).astype(np.uint8).reshape(camera.height, camera.width)


def degrees(a: F64, b: F64) -> F64:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ij,ij->i", a, b)))


def tracker(
    name: str,
    *,
    camera: Camera = SPHERE,
    mask: U8 | None = None,
    count: int = NUMBER,
    flow_unmatched: bool = True,
    weights: Path | None = None,
) -> DescriptorTracker:
    if missing_packages := plugins.missing(features.__name__, name):
        pytest.skip(f"{name} needs {missing_packages}")
    if weights is not None:
        import torch

        torch.set_num_threads(1)
    found = features.named(name, weights, count=1500, device="cpu")
    return DescriptorTracker(
        VirtualViews(camera), mask, count, found, matchers.named("nearest"), flow_unmatched=flow_unmatched
    )


def tracked_features(track: DescriptorTracker, frames: list[U8], turns: list[F64]) -> tuple[F64, F64, F64]:
    """First and last bearings (N, 3) of features tracked to the end, and their errors (N,) in degrees."""
    track.track(frames[0])
    track.refill()
    ids, start = track.tracks.ids, track.tracks.bearing
    for frame in frames[1:]:
        track.track(frame)
    _, i, j = np.intersect1d(ids, track.tracks.ids, return_indices=True)
    first, last = start[i], track.tracks.bearing[j]
    return first, last, degrees(last, first @ (turns[-1].T @ turns[0]).T)


@pytest.mark.parametrize("name", ["orb", "rootsift"])
def test_matching_is_as_good_at_poles_and_seam(name: str) -> None:
    check_poles_and_seam(name, ((0, 0, 0), (1, 0, 0), (0, 1, 0)))


def test_matching_by_aliked_is_as_good_at_poles_and_seam(real_data: Path) -> None:
    check_poles_and_seam("aliked", ((0, 0, 0), (1, 0, 0)), real_data / "weights" / "aliked" / "aliked-t16.pth")


def check_poles_and_seam(name: str, axes: tuple[tuple[int, int, int], ...], weights: Path | None = None) -> None:
    """Rotate poles and seam to the horizon: the number of matches and their accuracy must be equal."""
    counts, lasts, errors = [], [], []
    for axis in axes:
        base = exp_so3(np.multiply(axis, np.pi / 2))
        turns = [base, base @ exp_so3(np.radians([2.0, 4.0, 1.5]))]
        track = tracker(name, flow_unmatched=False, weights=weights)
        _, last, error = tracked_features(track, [noise_image(SPHERE, R) for R in turns], turns)
        assert np.median(error) < 0.1 and (error < 0.5).mean() > 0.97
        counts.append(len(last))
        lasts.append(last)
        errors.append(error)
    assert min(counts) > (0.25 if name == "orb" else 0.4) * NUMBER and min(counts) > 0.7 * max(counts)
    last, error = np.concatenate(lasts), np.concatenate(errors)
    pole = np.abs(last[:, 1]) > np.sin(np.radians(65))
    seam = (np.abs(np.arctan2(last[:, 0], last[:, 2])) > np.radians(165)) & ~pole
    for special in (pole, seam):
        assert special.sum() >= 10 and np.median(error[special]) < 0.1


@pytest.mark.parametrize(("axis", "step"), [((1.0, 0.0, 0.0), 1.0), ((0.0, 1.0, 0.0), 5.0)])
def test_tracks_continue_across_seam_and_poles(axis: tuple[float, float, float], step: float) -> None:
    """Features move from the horizon into the views of the poles, and across a pole or the seam."""
    turns = [exp_so3(np.radians(step * i) * np.array(axis)) for i in range(6)]
    camera = Camera("equirectangular", 640, 320)
    track = tracker("orb", camera=camera, count=700)
    first, last, error = tracked_features(track, [noise_image(camera, R) for R in turns], turns)
    assert len(first) > 500
    if axis[0]:  # the elevation changes, or the side of a pole
        moved = track.views.view_of(first) != track.views.view_of(last)
        passed = (np.abs(first[:, 1]) > 0.9) & (first[:, 2] * last[:, 2] < 0)
        assert passed.sum() >= 2 and np.median(error[passed]) < 0.1
    else:
        moved = (first[:, 2] < 0) & (last[:, 2] < 0) & (first[:, 0] * last[:, 0] < 0) & (np.abs(first[:, 1]) < 0.7)
    assert moved.sum() >= 8 and np.median(error[moved]) < 0.1


def test_matching_of_real_panoramas_is_accurate_at_poles_and_horizon(real_data: Path) -> None:
    import cv2

    file = real_data / "pano360" / "R0010118_20180720134544.JPG"
    large = cv2.imread(str(file), cv2.IMREAD_REDUCED_GRAYSCALE_4)
    assert large is not None
    source, camera = Camera("equirectangular", large.shape[1], large.shape[0]), Camera("equirectangular", 800, 400)
    for base in (np.eye(3), exp_so3(np.array([np.pi / 2, 0, 0]))):
        turns = [base, base @ exp_so3(np.radians([2.0, 3.0, 1.0]))]
        frames = []
        for R in turns:
            uv, _ = project(source, pixel_rays(camera).reshape(-1, 3) @ R.T)
            x, y = uv.reshape(400, 800, 2).transpose(2, 0, 1)
            frames.append(cv2.remap(large, np.ascontiguousarray(x), np.ascontiguousarray(y), 1, borderMode=3))
        first, _, error = tracked_features(tracker("rootsift", camera=camera, flow_unmatched=False), frames, turns)
        assert len(first) > 0.3 * NUMBER and np.median(error) < 0.1 and (error < 0.5).mean() > 0.9


def test_displacements_too_large_for_lucas_kanade_are_matched() -> None:
    camera = Camera("pinhole", 480, 320, 400.0, 400.0, 239.5, 159.5)
    turns = [np.eye(3), exp_so3(np.radians([1.0, 12.0, 0.0]))]  # 85 pixels
    track = tracker("rootsift", camera=camera, flow_unmatched=False)
    first, _, error = tracked_features(track, [noise_image(camera, R) for R in turns], turns)
    assert len(first) > 40 and np.median(error) < 0.1 and (error < 0.3).mean() > 0.9


def test_wrong_matches_are_rejected() -> None:
    class Wrong:
        name = "wrong"
        takes: str | None = None
        dimension: int | None = None

        def match(self, a: FeatureSet, b: FeatureSet, sizes: Any) -> Any:
            assert sizes[0] == sizes[1] and (a.uv[:, 0] < sizes[0][0]).all() and (a.uv[:, 1] < sizes[0][1]).all()
            n = min(len(a.uv), len(b.uv))
            return np.stack([np.arange(n), np.random.default_rng(0).permutation(n)], axis=1)

        def describe(self) -> str:
            return "wrong"

    turns = [np.eye(3), exp_so3(np.radians([0.0, 1.0, 0.0]))]
    frames = [noise_image(SPHERE, R) for R in turns]
    track = DescriptorTracker(VirtualViews(SPHERE), None, NUMBER, features.named("orb"), Wrong(), flow_unmatched=False)
    assert len(tracked_features(track, frames, turns)[0]) < 0.05 * NUMBER
    track = DescriptorTracker(VirtualViews(SPHERE), None, NUMBER, features.named("orb"), Wrong())
    first, _, error = tracked_features(track, frames, turns)
    assert len(first) > 0.5 * NUMBER and np.median(error) < 0.1


def test_interrupted_tracker_resumes_with_unique_ids(tmp_path: Path) -> None:
    mask = np.full((256, 512), 255, np.uint8)
    mask[180:] = 0
    track = tracker("orb", mask=mask)
    assert track.track(noise_image(SPHERE, np.eye(3))) == 0.0 and len(track.tracks) == 0 and len(track.images) == 3
    count = track.refill()
    ids = track.tracks.ids
    assert count == len(ids) == len(np.unique(ids)) > 0.5 * NUMBER and track.refill() < 0.2 * count
    below = np.degrees(np.arcsin(track.tracks.bearing[:, 1]))
    assert (below < 38).mean() > 0.99, "features on the ego vehicle"
    assert np.allclose(np.linalg.norm(track.tracks.bearing, axis=1), 1)
    track.drop(ids[:50])
    assert not np.isin(ids[:50], track.tracks.ids).any()
    save(tmp_path / "state.npz", track, VALUES)
    track = tracker("orb", mask=mask)
    load(tmp_path / "state.npz", track, VALUES)
    before = track.tracks
    turn = exp_so3(np.radians([0.0, 3.0, 0.0]))
    share = track.track(noise_image(SPHERE, turn), before.bearing @ turn)
    assert share == len(track.tracks) / len(before) > 0.6
    assert np.isin(track.tracks.ids, before.ids).all() and len(np.unique(track.tracks.ids)) == len(track.tracks)
    highest = max(ids.max(), track.tracks.ids.max())
    kept = set(track.tracks.ids.tolist())
    track.refill()
    fresh = set(track.tracks.ids.tolist()) - kept
    assert fresh and min(fresh) > highest, "an id was reused"
    track.tracks = type(track.tracks)()  # as odometry does after tracking loss
    assert track.refill() > 0.5 * NUMBER
    assert track.track(np.full((256, 512), 90, np.uint8)) == 0.0 and len(track.tracks) == 0
    assert track.refill() == 0
    track.track(noise_image(SPHERE, turn))
    assert track.refill() > 0.5 * NUMBER


def test_matcher_for_other_features_is_rejected() -> None:
    class Glue:
        name, takes, dimension = "superglue", "superpoint", 256

    with pytest.raises(SettingError, match="'superglue' was made for superpoint of 256 numbers, not for orb of 32 by"):
        DescriptorTracker(VirtualViews(SPHERE), None, 100, features.named("orb"), Glue())  # type: ignore[arg-type]


def test_superpoint_and_superglue_run_together(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    hf = pytest.importorskip("transformers")
    from tests.slam.test_features import SUPERPOINT, saved

    found = features.named("superpoint", saved(tmp_path / "superpoint_v1.pth", SUPERPOINT), count=100, device="cpu")
    hf.SuperGlueForKeypointMatching(hf.SuperGlueConfig()).save_pretrained(tmp_path / "superglue")
    matcher = matchers.named("superglue", tmp_path / "superglue", device="cpu")
    track = DescriptorTracker(VirtualViews(SPHERE), None, NUMBER, found, matcher)
    turns = [np.eye(3), exp_so3(np.radians([0.0, 1.0, 0.0]))]
    first, _, error = tracked_features(track, [noise_image(SPHERE, R) for R in turns], turns)
    assert len(first) > 20 and np.median(error) < 0.1
