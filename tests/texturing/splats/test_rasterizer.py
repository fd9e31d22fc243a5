"""The rasterizer of splats draws what the formulas say, and its gradients are those of what it draws."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_rays
from scan2sim.pipeline.camera.renderer import look_at
from scan2sim.pipeline.core.splats import Splats
from scan2sim.pipeline.core.types import F32, F64, Camera
from scan2sim.texturing.splats import blending, rasterizer, tiles
from scan2sim.texturing.splats.projection import Pinhole
from tests.texturing.splats import reference

CAMERA = Camera("pinhole", 52, 37, 40.0, 42.0, 25.3, 18.1)
POSE = look_at((0.3, -4.0, 1.2), (0, 0, 1))


def splats(number: int, seed: int = 1, scale: tuple[float, float] = (0.03, 0.4)) -> F32:
    """Parameters (N, 14) of random splats before the camera."""
    random = np.random.default_rng(seed)
    return Splats.of(
        random.uniform((-2, -2, -0.5), (2, 4, 2.5), (number, 3)),
        np.exp(random.uniform(np.log(scale[0]), np.log(scale[1]), (number, 3))),
        random.normal(size=(number, 4)),
        random.uniform(0.05, 0.95, number),
        random.uniform(0, 1, (number, 3)),
    ).parameters


def test_splats_are_drawn_as_the_formulas_say() -> None:
    parameters = splats(150)
    drawn = rasterizer.render(parameters, Pinhole.of(CAMERA, POSE))
    truth = reference.render(parameters.astype(float), CAMERA, POSE, least=1 / 255)
    # nothing is blended behind 0.3 % of transmittance; alphas at 1/255 may be rounded to either side
    error = np.abs(drawn.colour - truth.colour)
    assert error.max() < 0.005 and error.mean() < 0.001
    assert np.abs(drawn.transmittance - truth.transmittance).max() < 0.005
    sure = np.abs(truth.transmittance - 0.5) > 0.005
    assert np.array_equal(np.isfinite(drawn.depth)[sure], np.isfinite(truth.depth)[sure])
    both = np.isfinite(drawn.depth) & np.isfinite(truth.depth)
    # where a splat leaves about a half, the next may be the one
    assert both.mean() > 0.3 and (np.abs(drawn.depth[both] - truth.depth[both]) < 0.01).mean() > 0.99


def test_what_is_behind_or_beside_the_camera_is_not_drawn() -> None:
    parameters = splats(50)
    behind = np.eye(4)
    behind[:3, 3] = 0, 0, 8
    drawn = rasterizer.render(parameters, Pinhole.of(CAMERA, behind))
    assert len(drawn.seen) == 0 and not drawn.colour.any() and (drawn.transmittance == 1).all()


def test_a_splat_beside_the_image_does_not_explode() -> None:
    """Its centre is at 70 degrees, where the linearized projection of a large splat would cover the whole image."""
    near = Splats.of(
        np.array([[2.8, -3.0, 1.2]]), np.full((1, 3), 0.3), np.array([[1.0, 0, 0, 0]]), np.array([0.9]), np.ones((1, 3))
    )
    drawn = rasterizer.render(near.parameters, Pinhole.of(CAMERA, POSE))
    assert (drawn.transmittance[:, : CAMERA.width // 2] > 0.99).all()


def test_a_splat_that_is_long_and_narrow_is_drawn_as_the_formulas_say() -> None:
    """A wire of 300 m: with 32 bits, its determinant mustn't be a difference of large numbers."""
    half = np.pi / 8
    wire = Splats.of(
        np.array([[0.1, 0.0, 1.1]]), np.array([[300.0, 0.01, 0.01]]),
        np.array([[np.cos(half), 0, np.sin(half), 0]]), np.array([0.9]), np.array([[1.0, 0.5, 0.2]]),
    )  # fmt: skip
    drawn = rasterizer.render(wire.parameters, Pinhole.of(CAMERA, POSE))
    truth = reference.render(wire.parameters.astype(float), CAMERA, POSE, least=1 / 255)
    assert (truth.transmittance < 0.2).any() and (truth.transmittance > 0.99).mean() > 0.5
    assert np.abs(drawn.transmittance - truth.transmittance).max() < 0.01
    assert np.abs(drawn.colour - truth.colour).max() < 0.01


def test_splats_behind_opaque_ones_are_not_blended_in_tiles_at_the_border_either() -> None:
    """The walls end below the image, within the lowest tiles, of which only five rows are in the image."""
    facing, number, distance = np.array([0.70710678, 0.70710678, 0, 0]), 40, np.linspace(4, 4.4, 40)
    walls = Splats.of(
        np.column_stack([0 * distance, distance, (CAMERA.cy - 34) / CAMERA.fy * distance]),
        np.tile([4, 7 / CAMERA.fy * 4, 0.001], (number, 1)), np.tile(facing, (number, 1)), np.full(number, 0.98),
        np.ones((number, 3)),
    )  # fmt: skip
    drawn = rasterizer.render(walls.parameters, Pinhole.of(CAMERA, look_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))))
    lowest = slice(-(-CAMERA.width // blending.WIDTH), None)
    assert CAMERA.height - blending.HEIGHT == 5 and (np.diff(drawn._assignment.start)[lowest] == number).all()
    assert (drawn.transmittance[blending.HEIGHT :] < 0.003).all() and (drawn._last[lowest] <= 16).all()


def loss_of(parameters: F64, base: F64, weights: tuple[F64, F64, F64], background: F64, known: F64) -> float:
    """A linear function of the image that the reference draws."""
    drawn = reference.render(parameters, CAMERA, POSE, 1 / 255, base, known)
    over = drawn.colour + drawn.transmittance[..., None] * background
    of_depth, of_alpha = weights[1] * drawn.deviation, weights[2] * (1 - drawn.transmittance)
    return float((weights[0] * over).sum() + of_depth.sum() + of_alpha.sum())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_gradients_are_those_of_finite_differences(seed: int) -> None:
    random = np.random.default_rng(seed)
    parameters = splats(12, seed, scale=(0.1, 0.4))
    smooth = [np.cos(np.linspace(0, 3, CAMERA.width) + phase) for phase in random.uniform(0, 6, 5)]
    by_colour = np.stack(smooth[:3], axis=-1)[None] * np.ones((CAMERA.height, 1, 1))
    by_depth, by_alpha = smooth[3][None] * np.ones((CAMERA.height, 1)), smooth[4] * np.ones((CAMERA.height, 1))
    background = random.uniform(0, 1, (CAMERA.height, CAMERA.width, 3))
    known = np.zeros((CAMERA.height, CAMERA.width))
    known[:20] = 4.5  # some splats are nearer, some farther, some more than the greatest deviation away
    by_depth[:20] *= 3  # the rows below have no effect
    drawn = rasterizer.render(parameters, Pinhole.of(CAMERA, POSE), known.astype(np.float32))
    found = np.zeros(parameters.shape)
    found[drawn.seen] = drawn.gradients(
        *(one.astype(np.float32) for one in (background, by_colour, by_depth, by_alpha))
    )
    base, expected, step = parameters.astype(float), np.zeros(parameters.shape), 1e-4
    for i in range(len(parameters)):
        for k in range(parameters.shape[1]):
            values = []
            for sign in (1, -1):
                moved = base.copy()
                moved[i, k] += sign * step
                values.append(loss_of(moved, base, (by_colour, by_depth, by_alpha), background, known))
            expected[i, k] = (values[0] - values[1]) / (2 * step)
    for k in range(parameters.shape[1]):
        scale = np.abs(expected[:, k]).max()
        assert np.abs(found[:, k] - expected[:, k]).max() < 0.03 * scale, f"parameter {k}"


@pytest.mark.parametrize("seed", [1, 2])
def test_deviations_from_known_depths_are_those_of_the_formulas(seed: int) -> None:
    parameters = splats(60, seed, scale=(0.05, 0.4))
    known = np.random.default_rng(seed).uniform(3, 7, (CAMERA.height, CAMERA.width))
    known[::3] = 0
    drawn = rasterizer.render(parameters, Pinhole.of(CAMERA, POSE), known.astype(np.float32))
    truth = reference.render(parameters.astype(float), CAMERA, POSE, 1 / 255, known=known)
    assert np.abs(drawn.deviation - truth.deviation).max() < 0.005
    assert drawn.deviation[1].any() and not drawn.deviation[::3].any()


def true_depth(camera: Camera, pose: F64, height: float) -> F64:
    """(H, W) depth of the horizontal plane z = `height`, negative above the horizon."""
    rays = pixel_rays(camera).astype(np.float64)
    rays /= rays[..., 2:]
    return np.asarray((height - pose[2, 3]) / (rays @ pose[:3, :3].T)[..., 2])


def test_depth_is_that_of_the_plane_in_which_flat_splats_lie() -> None:
    """Not that of their centres: one splat covers depths of a metre here."""
    floor = Splats.of(
        np.array([[0, 0, 0.0]]), np.array([[0.5, 0.5, 0.001]]), np.array([[1.0, 0, 0, 0]]), np.array([0.99]),
        np.ones((1, 3)),
    )  # fmt: skip
    drawn = rasterizer.render(floor.parameters, Pinhole.of(CAMERA, POSE))
    truth, seen = true_depth(CAMERA, POSE, 0.0), np.isfinite(drawn.depth)
    assert np.ptp(truth[seen]) > 0.9
    assert np.abs(drawn.depth - truth)[seen].max() < 0.01


def test_a_road_is_as_far_as_it_is() -> None:
    """Its splats overlap; by the depths of their centres it would be decimetres nearer, as the nearer hide the others.

    They are as thick and as far from each other as those that training begins with, 17 m ahead of a car's camera.
    """
    camera = Camera("pinhole", 60, 24, 700.0, 700.0, 29.5, -57.0)
    pose = look_at((0.0, 0.0, 1.65), (10.0, 0.0, 1.65))
    step, random = 17 * 4.5 / 700, np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(12, 30, step), np.arange(-1.5, 1.5, step))
    xyz = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) + random.uniform(-0.5, 0.5, (x.size, 3)) * (
        step, step, 0,
    )  # fmt: skip
    scale = 0.51 * step * np.tile([1, 1, 0.25], (x.size, 1))
    ones = np.ones(x.size)
    road = Splats.of(xyz, scale, np.tile([1.0, 0, 0, 0], (x.size, 1)), 0.73 * ones, np.tile(0.5, (x.size, 3)))
    drawn = rasterizer.render(road.parameters, Pinhole.of(camera, pose))
    truth = true_depth(camera, pose, 0.0)
    assert (truth > 14).all() and (truth < 22).all() and np.isfinite(drawn.depth).all()
    assert abs(np.median(drawn.depth - truth)) < 0.02 and np.abs(drawn.depth - truth).mean() < 0.05


def test_depth_is_that_of_what_stops_half_of_the_light() -> None:
    """Before a wall is glass that stops a third of it: the mean would be in the air between both."""
    facing = np.array([[0.70710678, 0.70710678, 0, 0], [0.70710678, 0.70710678, 0, 0]])  # normals along y
    both = Splats.of(
        np.array([[0.3, 0.0, 1.2], [0.3, 4.0, 1.2]]), np.array([[2.0, 2, 0.01], [4.0, 4, 0.01]]), facing,
        np.array([0.33, 0.98]), np.ones((2, 3)),
    )  # fmt: skip
    pose = look_at((0.3, -4.0, 1.2), (0.3, 0.0, 1.2))
    drawn = rasterizer.render(both.parameters, Pinhole.of(CAMERA, pose))
    assert drawn.depth[18, 25] == pytest.approx(8.0, abs=0.02)
    assert np.isinf(rasterizer.render(both.parameters[:1], Pinhole.of(CAMERA, pose)).depth).all()


def test_images_and_gradients_do_not_depend_on_the_number_of_threads() -> None:
    parameters, camera = splats(2000, scale=(0.02, 0.1)), Pinhole.of(CAMERA, POSE)
    found = []
    before = numba.get_num_threads()
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            drawn = rasterizer.render(parameters, camera)
            found.append((drawn.colour, drawn.gradients(0 * drawn.colour, 1 + 0 * drawn.colour)))
    finally:
        numba.set_num_threads(before)
    assert all(np.array_equal(*pair) for pair in zip(*found, strict=True))


def test_images_in_tiles_are_restored() -> None:
    image = np.random.default_rng(1).uniform(size=(37, 52, 3)).astype(np.float32)
    assert np.array_equal(tiles.from_tiles(tiles.to_tiles(image), 52, 37), image)
