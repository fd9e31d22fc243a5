"""What the quick renderer draws is what rays see (`pipeline.camera.renderer`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.camera import renderer
from scan2sim.pipeline.camera.renderer import Body, Renderer, look_at, pinhole
from scan2sim.pipeline.core.types import F64, Frame, Mesh
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds.textured_mesh import Textured, vertex_normals
from scan2sim.services.teleoperation.sim.world_renderer import SKY, Eye, world

CAMERA = pinhole(160, 120)


def shape(folder: Path, places: object, faces: object, uv: object, pages: int = 1) -> Textured:
    """A mesh on a page of smooth colours; each further page is of one colour."""
    files = tuple(folder / f"page_{i}.png" for i in range(pages))
    noise = np.random.default_rng(0).integers(0, 255, (8, 8, 3), np.uint8)
    image.write(files[0], np.asarray(cv2.resize(noise, (512, 384), interpolation=cv2.INTER_CUBIC), np.uint8))
    for i, file in enumerate(files[1:]):
        image.write(file, np.full((20, 30, 3), 60 * (i + 1), np.uint8))
    index = np.asarray(faces, np.int32)
    mesh = Mesh(
        Frame(), np.asarray(places, np.float32), index, uv=np.asarray(uv, np.float32),
        page=(np.arange(len(index)) % pages).astype(np.int32),
    )  # fmt: skip
    return Textured(mesh, vertex_normals(mesh), files)


def soup(folder: Path, count: int, size: float) -> Textured:
    """Triangles of that size anywhere in a room of 20 m."""
    rng = np.random.default_rng(1)
    middles = rng.uniform(-10, 10, (count, 1, 3))
    places = (middles + rng.normal(0, size, (count, 3, 3))).reshape(-1, 3)
    return shape(folder, places, np.arange(3 * count).reshape(-1, 3), rng.uniform(0.1, 0.9, (count, 3, 2)), pages=3)


def rays(shapes: list[Textured], pose: F64, offset: tuple[float, float, float] = (0, 0, 0)) -> renderer.Image:
    shift = np.array(offset, np.float32)
    bodies = [Body(replace(one.mesh, vertices=one.mesh.vertices + shift), one.pages) for one in shapes]
    return Renderer(bodies).view(CAMERA, pose, background=SKY)


@pytest.mark.parametrize("count, size", [(40, 3.0), (3000, 0.3)])
def test_it_draws_what_rays_see(tmp_path: Path, count: int, size: float) -> None:
    shapes = [soup(tmp_path, count, size)]
    eye = Eye(world([(shapes[0], (0.0, 0.0, 0.0))]), CAMERA)
    for place, target in (((0, 0, 0), (1, 0, 0)), ((-18, 3, 4), (0, 0, 0)), ((2, -3, 9), (1, 1, -9))):
        pose = look_at(place, target)
        drawn, wanted = eye.view(pose), rays(shapes, pose)
        sky = (drawn == SKY).all(axis=-1)
        assert np.mean(sky == ~wanted.hit) > 0.99
        apart = np.abs(drawn.astype(int) - wanted.rgb).max(axis=-1)
        assert np.mean(apart < 40) > 0.9 and np.median(apart) < 12


def test_a_floor_goes_on_below_and_behind_the_camera(tmp_path: Path) -> None:
    floor = shape(
        tmp_path, [(-50, -50, 0), (50, -50, 0), (50, 50, 0), (-50, 50, 0)], [(0, 1, 2), (0, 2, 3)],
        [[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]],
    )  # fmt: skip
    pose = look_at((0.3, 0.2, 1.5), (5, 1, 0.5))
    drawn, wanted = Eye(world([(floor, (0.0, 0.0, 0.0))]), CAMERA).view(pose), rays([floor], pose)
    assert np.mean((drawn == SKY).all(axis=-1) == ~wanted.hit) > 0.998
    assert wanted.hit[60:].all() and np.abs(drawn[80:].astype(int) - wanted.rgb[80:]).mean() < 6


def test_tiles_are_where_they_belong(tmp_path: Path) -> None:
    offset = (30.0, -5.0, 2.0)
    shapes = [soup(tmp_path, 200, 1.0)]
    pose = look_at((10, -5, 2), offset)
    drawn, wanted = Eye(world([(shapes[0], offset)]), CAMERA).view(pose), rays(shapes, pose, offset)
    assert np.mean((drawn == SKY).all(axis=-1) == ~wanted.hit) > 0.98


def test_far_textures_are_smooth(tmp_path: Path) -> None:
    wall = shape(tmp_path, [(0, -5, -5), (0, 5, -5), (0, 5, 5), (0, -5, 5)], [(0, 1, 2), (0, 2, 3)],
                 [[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]])  # fmt: skip
    noise = np.random.default_rng(0).integers(0, 255, (1024, 1024, 3), np.uint8)
    image.write(wall.pages[0], noise)
    drawn = Eye(world([(wall, (0.0, 0.0, 0.0))]), CAMERA).view(look_at((-60, 0, 0), (0, 0, 0)))
    seen = drawn[56:64, 76:84].astype(float)
    assert np.abs(seen - 127).max() < 40  # a texel alone may be anything
