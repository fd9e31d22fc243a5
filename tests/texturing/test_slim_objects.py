"""A thin post in front of a wall and grass: its colour is not projected onto surfaces behind it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera.renderer import Body, Renderer, look_at, pinhole, textured
from scan2sim.pipeline.core.types import F32, U8, Frame, Mesh
from scan2sim.pipeline.geometry import primitives
from tests.texturing.corner import BOX, CAMERAS, GROUND, Street, photograph
from tests.texturing.test_texture import from_above

POSES = [look_at((-4, y, 1.8), (0, y / 2, 0.6)) for y in (-0.2, 0.2)]
RADIUS_M, POSE_ERROR_M = 0.05, 0.12


def post(y: float) -> Mesh:
    """A post of 1 m in front of the box."""
    vertices, faces = primitives.tube([(-2.0, y, 0.0), (-2.0, y, 1.0)], [RADIUS_M, RADIUS_M], 8)
    return Mesh(Frame(), vertices.astype(np.float32), faces)


def points_on(y: float) -> F32:
    """Points on its side."""
    rng = np.random.default_rng(0)
    angle, z = rng.uniform(0, 2 * np.pi, 400), rng.uniform(0, 1, 400)
    xy = np.column_stack([-2 + RADIUS_M * np.cos(angle), y + RADIUS_M * np.sin(angle)])
    return np.column_stack([xy, z]).astype(np.float32)


def front_of_the_box(folder: Path) -> U8:
    """The textured box from the front (H, W, 3)."""
    return Renderer([textured(folder)]).view(pinhole(200, 200, field=60), look_at((-3, 0, 1), (0, 0, 1))).rgb


def test_colour_of_a_post_is_not_projected_onto_ground_and_wall(street: Street) -> None:
    for pose in POSES:
        image = photograph(CAMERAS["pinhole"], pose)
        view = Renderer([Body(GROUND), Body(BOX), Body(post(POSE_ERROR_M))]).view(CAMERAS["pinhole"], pose)
        bare = Renderer([Body(GROUND), Body(BOX)]).view(CAMERAS["pinhole"], pose)
        image[view.range < bare.range - 0.01] = (255, 0, 255)
        street.add(CAMERAS["pinhole"], pose, image)
    street.occluders = (GROUND, BOX, post(0.0))

    def printed(mesh: Mesh) -> int:
        street.mesh = mesh
        folder, _ = street.run(agreement={"ghosts": False, "align": False})
        rgb = (from_above(folder)[0] if mesh is GROUND else front_of_the_box(folder)).astype(float)
        return int(((rgb[..., 0] > 150) & (rgb[..., 1] < 90) & (rgb[..., 2] > 150)).sum())

    ground, wall = printed(GROUND), printed(BOX)
    assert ground > 20 and wall > 20
    street.slim = np.concatenate([points_on(0.0), points_on(POSE_ERROR_M)])  # the scan has the same error
    assert printed(BOX) == 0
    assert printed(GROUND) < ground / 4  # the rest is at the foot of the post
