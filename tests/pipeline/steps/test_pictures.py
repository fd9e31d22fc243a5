"""Images of the report: the camera pose of the first one, rooms from above."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.camera.renderer import Body, Renderer, pinhole
from scan2sim.pipeline.core.types import Frame, Mesh
from scan2sim.pipeline.steps.pictures import whole_pose, without_ceilings


@pytest.mark.parametrize("size", [(100, 20, 8), (30, 200, 40), (50, 50, 1)])
def test_all_points_fill_the_image(size: tuple[float, float, float]) -> None:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (5000, 3)) * size + (300.0, -40.0, 12.0)
    camera = pinhole(1280, 720, field=75)
    pose = whole_pose(points, camera)
    T = np.linalg.inv(pose)
    uv, valid = project(camera, points @ T[:3, :3].T + T[:3, 3])
    low, high = uv.min(axis=0), uv.max(axis=0)
    assert valid.all() and (low > -1.5).all() and (high < [1280.5, 720.5]).all()
    assert (high - low)[0] > 1270 or (high - low)[1] > 710
    assert pose[2, 2] < -0.3 and pose[2, 3] > points[:, 2].max()  # looks down from above


def test_rooms_are_seen_from_above() -> None:
    square = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    colours = {"terrain": (90, 60, 30), "ceiling": (220, 220, 214)}
    heights = {"terrain": 0, "ceiling": 3}
    lifted = {group: (square + [0, 0, height]).astype(np.float32) for group, height in heights.items()}
    world = Renderer([Body(Mesh(Frame(), lifted[group], faces), colour=colours[group]) for group in colours])

    def middle(shown: Renderer) -> tuple[int, ...]:
        rgb = shown.above(np.zeros(3), np.array([4.0, 4, 4]), width=9).rgb
        return tuple(rgb[4, 4].tolist())

    assert middle(world) == colours["ceiling"]
    assert middle(without_ceilings(list(colours), world)) == colours["terrain"]
    assert without_ceilings(["terrain", "building"], world) is world
