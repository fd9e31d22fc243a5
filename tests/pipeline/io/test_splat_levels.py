"""Levels of detail of splats: leaves hold all of them, parents fewer that show the same."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from scan2sim.pipeline.core.splats import Splats
from scan2sim.pipeline.core.types import Camera
from scan2sim.pipeline.io.worlds import splat_levels
from scan2sim.pipeline.io.worlds.splat_levels import SplatLevel
from scan2sim.texturing.splats import rasterizer
from scan2sim.texturing.splats.projection import Pinhole
from tests.fakes.splat_scenes import layer

MAX_SPLATS = 400


def every(level: SplatLevel) -> Iterator[SplatLevel]:
    yield level
    for finer in level.finer:
        yield from every(finer)


@pytest.fixture(scope="module")
def root() -> SplatLevel:
    return splat_levels.levels(layer().splats, MAX_SPLATS)


def test_leaves_hold_all_splats_once(root: SplatLevel) -> None:
    leaves = list(root.leaves())
    assert len(leaves) > 4 and max(len(leaf.splats) for leaf in leaves) <= MAX_SPLATS
    found = np.concatenate([leaf.splats.parameters for leaf in leaves])
    given = layer().splats.parameters
    assert np.array_equal(found[np.lexsort(found.T)], given[np.lexsort(given.T)])


def test_parents_have_fewer_splats_and_larger_spacings_than_their_children(root: SplatLevel) -> None:
    parents = [level for level in every(root) if level.finer]
    assert parents
    for level in parents:
        assert len(level.splats) <= splat_levels.MERGED_SHARE * sum(len(one.splats) for one in level.finer)
        assert len(level.splats) <= MAX_SPLATS and level.spacing > max(one.spacing for one in level.finer)
    assert all(leaf.spacing == 0 for leaf in root.leaves())


def test_merging_keeps_centre_colour_and_shape() -> None:
    """Two halves of one ellipsoid have its mean and its covariance."""
    shift = np.array([0.05, 0.02, 0.0])
    pair = Splats.of(
        np.array([shift, -shift]) + (1, 2, 3), np.full((2, 3), (0.1, 0.05, 0.01)), np.array([[1.0, 0, 0, 0]] * 2),
        np.full(2, 0.3), np.array([[0.2, 0.4, 0.6], [0.4, 0.6, 0.8]]),
    )  # fmt: skip
    one = splat_levels.merge(pair, np.zeros(2, np.int64))
    assert np.allclose(one.xyz, [[1, 2, 3]], atol=1e-6) and np.allclose(one.rgb, [[0.3, 0.5, 0.7]], atol=1e-6)
    assert np.allclose(one.covariance[0], np.diag([0.01, 0.0025, 0.0001]) + np.outer(shift, shift), atol=1e-7)
    assert 0.3 < one.opacity[0] < 0.6


def test_splats_of_their_own_group_stay_as_they_are() -> None:
    given = layer(count=50).splats
    assert splat_levels.merge(given, np.arange(50)) is given
    group = np.append(np.zeros(2, np.int64), np.arange(1, 49))
    assert np.array_equal(splat_levels.merge(given, group).parameters[:48], given.parameters[2:])


def wall(step: float = 0.02) -> Splats:
    """An opaque wall of 4 x 4 m at x = 10 m, smoothly coloured."""
    y, z = (axis.ravel() for axis in np.meshgrid(*[np.arange(-2, 2, step)] * 2))
    count = len(y)
    rgb = np.column_stack([0.5 + 0.4 * np.sin(y), 0.5 + 0.4 * np.cos(z), np.full(count, 0.3)])
    return Splats.of(
        np.column_stack([np.full(count, 10.0), y, z]), np.full((count, 3), (step / 10, step, step)),
        np.array([[1.0, 0, 0, 0]] * count), np.full(count, 0.8), rgb,
    )  # fmt: skip


def test_a_merged_wall_stays_opaque_and_keeps_its_colours() -> None:
    """From where a cell of the merged level is two pixels."""
    fine = wall()
    coarse = splat_levels.levels(fine, 25_000)
    while coarse.finer[0].finer:
        coarse = coarse.finer[0]
    assert 0 < coarse.spacing < 0.2 and len(coarse.splats) <= 0.25 * len(fine)
    focal = 2 * 10 / coarse.spacing
    ahead = np.eye(4)
    ahead[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    size = round(0.3 * focal)
    camera = Pinhole.of(Camera("pinhole", size, size, focal, focal, (size - 1) / 2, (size - 1) / 2), ahead)
    white = np.ones((size, size, 3), np.float32)
    images = [rasterizer.render(splats.parameters, camera).over(white) for splats in (fine, coarse.splats)]
    assert np.abs(images[0] - images[1]).mean() < 0.02 and np.abs(images[0] - images[1]).max() < 0.15


def test_splats_in_one_place_are_a_leaf() -> None:
    given = layer(count=100).splats.parameters.copy()
    given[:, :3] = 5
    root = splat_levels.levels(Splats(given), 10)
    assert not root.finer and len(root.splats) == 100


def test_bounds_contain_three_standard_deviations() -> None:
    given = layer(count=200).splats
    low, high = splat_levels.bounds(given)
    random = np.random.default_rng(1)
    direction = random.normal(size=(200, 3))
    direction *= splat_levels.BOX_DEVIATIONS / np.linalg.norm(direction, axis=1, keepdims=True)
    surface = given.xyz + np.einsum("nij,nj->ni", np.linalg.cholesky(given.covariance + 1e-12 * np.eye(3)), direction)
    assert (surface >= low - 1e-4).all() and (surface <= high + 1e-4).all()
    assert (low > given.xyz.min(axis=0) - 3 * given.scale.max() - 1e-4).all()
