"""Loop closures in the pose graph, and place recognition by thumbnails."""

import itertools

import numpy as np

from scan2sim.pipeline.core.types import F64
from scan2sim.slam.geometry import exp_so3, inverse, rigid
from scan2sim.slam.global_map.loop_closure import optimize_pose_graph, thumbnail, thumbnail_correlation


def ring(n: int = 80, radius: float = 30.0) -> F64:
    angles = np.linspace(0, 2 * np.pi * 1.1, n)
    return np.stack([rigid(exp_so3([0, a, 0]), radius * np.array([np.sin(a), 0, np.cos(a)])) for a in angles])


def drifted(truth: F64, turn: float = 0.002, stretch: float = 1.01) -> F64:
    out = [truth[0]]
    for a, b in itertools.pairwise(truth):
        step = inverse(a) @ b
        step[:3, 3] *= stretch
        out.append(out[-1] @ step @ rigid(exp_so3([0, turn, 0]), np.zeros(3)))
    return np.stack(out)


def test_loop_closure_reduces_drift_and_false_loops_are_rejected() -> None:
    truth = ring()
    path = drifted(truth)
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1))])

    def off(found: F64) -> F64:
        return np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1)

    loops = [(j, k, inverse(truth[j]) @ truth[k]) for j, k in ((0, 73), (2, 75), (4, 77))]
    assert off(optimize_pose_graph(path, way, loops)).max() < 0.35 * off(path).max()
    false = [(10, 40, np.eye(4))]
    both = optimize_pose_graph(path, way, loops + false)
    assert off(both).max() < 0.5 * off(path).max()


def test_place_recognition_of_panoramas_is_independent_of_heading() -> None:
    rng = np.random.default_rng(0)
    import cv2

    panorama, other = (cv2.GaussianBlur(rng.integers(0, 255, (100, 640), np.uint8), (0, 0), 9) for _ in range(2))
    panorama, other = (cv2.normalize(p, None, 0, 255, cv2.NORM_MINMAX) for p in (panorama, other))
    turned = np.roll(panorama, 250, axis=1)
    assert thumbnail_correlation(thumbnail(panorama), thumbnail(turned), panoramic=True) > 0.8
    assert thumbnail_correlation(thumbnail(panorama), thumbnail(turned), panoramic=False) < 0.5
    assert thumbnail_correlation(thumbnail(panorama), thumbnail(other), panoramic=True) < 0.6
