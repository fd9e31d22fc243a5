"""The rasterizer of splats draws what the formulas say, and its gradients are those of what it draws."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_rays
from scan2sim.pipeline.camera.renderer import look_at
from scan2sim.pipeline.core.splats import Splats
from scan2sim.pipeline.core.types import F32, F64, Camera
from scan2sim.texturing.splats import rasterizer, tiles
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
    colour, depth, through = reference.render(parameters.astype(float), CAMERA, POSE, least=1 / 255)
    # nothing is blended behind 0.3 % of transmittance; alphas at 1/255 may be rounded to either side
    assert np.abs(drawn.colour - colour).max() < 0.005 and np.abs(drawn.colour - colour).mean() < 0.001
    assert np.abs(drawn.transmittance - through).max() < 0.005
    assert np.abs(drawn.depth - depth).max() < 0.05


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


def loss_of(parameters: F64, base: F64, weights: tuple[F64, F64, F64], background: F64, known: F64) -> float:
    """A linear function of the image that the reference draws."""
    colour, depth, through = reference.render(parameters, CAMERA, POSE, 1 / 255, base, known)
    over = colour + through[..., None] * background
    return float((weights[0] * over).sum() + (weights[1] * depth).sum() + (weights[2] * (1 - through)).sum())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_gradients_are_those_of_finite_differences(seed: int) -> None:
    random = np.random.default_rng(seed)
    parameters = splats(12, seed, scale=(0.1, 0.4))
    smooth = [np.cos(np.linspace(0, 3, CAMERA.width) + phase) for phase in random.uniform(0, 6, 5)]
    by_colour = np.stack(smooth[:3], axis=-1)[None] * np.ones((CAMERA.height, 1, 1))
    by_depth, by_alpha = 0.1 * smooth[3][None] * np.ones((CAMERA.height, 1)), smooth[4] * np.ones((CAMERA.height, 1))
    background = random.uniform(0, 1, (CAMERA.height, CAMERA.width, 3))
    known = np.zeros((CAMERA.height, CAMERA.width))
    known[:20] = 4.5  # some splats are nearer, some farther, some more than the greatest deviation away
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


def test_depth_is_that_of_the_plane_in_which_flat_splats_lie() -> None:
    """Not that of their centres: one splat covers depths of a metre and more here."""
    floor = Splats.of(
        np.array([[0, 0, 0.0]]), np.array([[0.5, 0.5, 0.001]]), np.array([[1.0, 0, 0, 0]]), np.array([0.99]),
        np.ones((1, 3)),
    )  # fmt: skip
    drawn = rasterizer.render(floor.parameters, Pinhole.of(CAMERA, POSE))
    rays = pixel_rays(CAMERA).astype(np.float64)
    rays /= rays[..., 2:]
    truth = -POSE[2, 3] / (rays @ POSE[:3, :3].T)[..., 2]
    cover = 1 - drawn.transmittance
    sure = cover > 0.3
    found = (drawn.depth / np.maximum(cover, 1e-6))[sure]
    assert np.ptp(truth[sure]) > 1
    # the projection is linearized in the centre
    assert np.abs(found - truth[sure]).max() < 0.25 * np.ptp(truth[sure])
    assert np.median(np.abs(found - truth[sure])) < 0.1 * np.ptp(truth[sure])


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
