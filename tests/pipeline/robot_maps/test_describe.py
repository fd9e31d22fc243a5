"""What a map shows of itself."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.pipeline.robot_maps.describe import describe


@pytest.mark.parametrize("spacing", [0.02, 0.2])
@pytest.mark.parametrize("noise", [0.0, 0.005, 0.05])
def test_noise_of_a_room_whatever_its_spacing(spacing: float, noise: float) -> None:
    rng = np.random.default_rng(0)
    parts = []
    for axis in range(3):  # floor and two walls, 6 m by 6 m
        part = rng.uniform(0, 6, (round(36 / spacing**2), 3))
        part[:, axis] = rng.normal(0, noise, len(part))
        parts.append(part)
    xyz = rng.permutation(np.concatenate(parts).astype(np.float32))
    assert describe(xyz, np.full(3, 1.5)).noise == pytest.approx(noise, rel=0.15, abs=1e-4)


def test_bushes_count_as_no_noise_where_the_ground_is_flat() -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(0, 20, (40_000, 2)), rng.normal(0, 0.01, 40_000)])
    bushes = rng.uniform(0, (20, 5, 2), (10_000, 3))
    xyz = rng.permutation(np.concatenate([ground, bushes]).astype(np.float32))
    assert describe(xyz, np.full(3, 1.5)).noise == pytest.approx(0.01, rel=0.3)
