"""The rasterizer of `sim.world_renderer` draws what the ray caster sees (`pipeline.camera.renderer`)."""

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
from scan2sim.services.teleoperation.sim.world_renderer import SKY_RGB, WorldRenderer, build_world

CAMERA = pinhole(160, 120)


def shape(folder: Path, vertices: object, faces: object, uv: object, pages: int = 1) -> Textured:
    """A mesh whose first texture page has smooth colours; each further page has one colour."""
    files = tuple(folder / f"page_{i}.png" for i in range(pages))
    noise = np.random.default_rng(0).integers(0, 255, (8, 8, 3), np.uint8)
    image.write(files[0], np.asarray(cv2.resize(noise, (512, 384), interpolation=cv2.INTER_CUBIC), np.uint8))
    for i, file in enumerate(files[1:]):
        image.write(file, np.full((20, 30, 3), 60 * (i + 1), np.uint8))
    index = np.asarray(faces, np.int32)
    mesh = Mesh(
        Frame(), np.asarray(vertices, np.float32), index, uv=np.asarray(uv, np.float32),
        page=(np.arange(len(index)) % pages).astype(np.int32),
    )  # fmt: skip
    return Textured(mesh, vertex_normals(mesh), files)


def soup(folder: Path, count: int, size: float) -> Textured:
    """Random triangles of about this size within 20 m."""
    rng = np.random.default_rng(1)
    centres = rng.uniform(-10, 10, (count, 1, 3))
    vertices = (centres + rng.normal(0, size, (count, 3, 3))).reshape(-1, 3)
    return shape(folder, vertices, np.arange(3 * count).reshape(-1, 3), rng.uniform(0.1, 0.9, (count, 3, 2)), pages=3)


def ray_cast(shapes: list[Textured], pose: F64, offset: tuple[float, float, float] = (0, 0, 0)) -> renderer.Image:
    shift = np.array(offset, np.float32)
    bodies = [Body(replace(one.mesh, vertices=one.mesh.vertices + shift), one.pages) for one in shapes]
    return Renderer(bodies).view(CAMERA, pose, background=SKY_RGB)


@pytest.mark.parametrize("count, size", [(40, 3.0), (3000, 0.3)])
def test_rasterizer_matches_ray_casting(tmp_path: Path, count: int, size: float) -> None:
    shapes = [soup(tmp_path, count, size)]
    rasterizer = WorldRenderer(build_world([(shapes[0], (0.0, 0.0, 0.0))]), CAMERA)
    for position, target in (((0, 0, 0), (1, 0, 0)), ((-18, 3, 4), (0, 0, 0)), ((2, -3, 9), (1, 1, -9))):
        pose = look_at(position, target)
        drawn, expected = rasterizer.view(pose), ray_cast(shapes, pose)
        sky = (drawn == SKY_RGB).all(axis=-1)
        assert np.mean(sky == ~expected.hit) > 0.99
        difference = np.abs(drawn.astype(int) - expected.rgb).max(axis=-1)
        assert np.mean(difference < 40) > 0.9 and np.median(difference) < 12


def test_floor_extends_below_and_behind_the_camera(tmp_path: Path) -> None:
    floor = shape(
        tmp_path, [(-50, -50, 0), (50, -50, 0), (50, 50, 0), (-50, 50, 0)], [(0, 1, 2), (0, 2, 3)],
        [[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]],
    )  # fmt: skip
    pose = look_at((0.3, 0.2, 1.5), (5, 1, 0.5))
    drawn, expected = WorldRenderer(build_world([(floor, (0.0, 0.0, 0.0))]), CAMERA).view(pose), ray_cast([floor], pose)
    assert np.mean((drawn == SKY_RGB).all(axis=-1) == ~expected.hit) > 0.998
    assert expected.hit[60:].all() and np.abs(drawn[80:].astype(int) - expected.rgb[80:]).mean() < 6


def test_tile_offsets_are_applied(tmp_path: Path) -> None:
    offset = (30.0, -5.0, 2.0)
    shapes = [soup(tmp_path, 200, 1.0)]
    pose = look_at((10, -5, 2), offset)
    drawn = WorldRenderer(build_world([(shapes[0], offset)]), CAMERA).view(pose)
    expected = ray_cast(shapes, pose, offset)
    assert np.mean((drawn == SKY_RGB).all(axis=-1) == ~expected.hit) > 0.98


def test_distant_textures_are_smoothed(tmp_path: Path) -> None:
    wall = shape(tmp_path, [(0, -5, -5), (0, 5, -5), (0, 5, 5), (0, -5, 5)], [(0, 1, 2), (0, 2, 3)],
                 [[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]])  # fmt: skip
    noise = np.random.default_rng(0).integers(0, 255, (1024, 1024, 3), np.uint8)
    image.write(wall.pages[0], noise)
    drawn = WorldRenderer(build_world([(wall, (0.0, 0.0, 0.0))]), CAMERA).view(look_at((-60, 0, 0), (0, 0, 0)))
    seen = drawn[56:64, 76:84].astype(float)
    assert np.abs(seen - 127).max() < 40  # a single texel may have any value
