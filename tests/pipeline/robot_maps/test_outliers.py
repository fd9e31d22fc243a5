"""Outliers and duplicates of maps, compared with slow reference implementations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from scan2sim.pipeline.core.types import F32
from scan2sim.pipeline.importers.robot_map import _repeated
from scan2sim.pipeline.robot_maps.outliers import ISOLATED_NEIGHBOURS, ISOLATED_SPACINGS, far_outliers

SPACING_M = 0.1


def sheet(far: float, seed: int = 0) -> F32:
    """A noisy sheet on a grid with a few points above it, and others as far away as `far` in metres."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(40) * SPACING_M, np.arange(40) * SPACING_M)
    grid = np.column_stack([x.ravel(), y.ravel(), rng.normal(0, 0.01, x.size)])
    above = rng.uniform((0, 0, 0.3), (4, 4, 1.5), (12, 3))
    return np.concatenate([grid, above, rng.normal(0, far, (5, 3))]).astype(np.float32)


@pytest.mark.parametrize("far", [30.0, 1e7])
def test_isolated_and_far_points_are_those_of_an_exhaustive_search(far: float) -> None:
    xyz = sheet(far)
    near = np.sort(cdist(xyz, xyz), axis=1)[:, ISOLATED_NEIGHBOURS]
    isolated = near > ISOLATED_SPACINGS * SPACING_M
    assert 5 <= isolated.sum() < 17  # the far ones, and some of those above
    found = far_outliers(xyz, SPACING_M)
    assert found[-5:].all() and found[isolated].all()
    assert not found[: 40 * 40].any()


def test_all_but_the_first_of_equal_points_are_repeated() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.integers(-3, 3, (5_000, 3)).astype(np.float32)  # on a grid: most coordinates are equal
    xyz[::11] *= np.float32(-1)  # with negative zeros
    first = np.unique(xyz + 0.0, axis=0, return_index=True)[1]
    assert np.array_equal(np.flatnonzero(~_repeated(xyz)), np.sort(first))
