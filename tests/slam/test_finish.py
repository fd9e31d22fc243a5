"""How sure a trajectory is of itself."""

from __future__ import annotations

import numpy as np
import pytest

from scan2sim.slam.finish import uncertainty


def test_positions_and_directions_drift_with_the_way_and_faster_where_nothing_was_seen() -> None:
    times = np.arange(101.0)
    positions = np.column_stack([10 * times, 0 * times, 0 * times])
    unsure = np.zeros(101, bool)
    metres, radians = np.sqrt(np.einsum("tkk->tk", uncertainty(times, positions, unsure))[-1].reshape(2, 3))
    assert metres == pytest.approx(3.0) and radians == pytest.approx(0.02)  # after 1 km: 0.3 %, about a degree
    unsure[50:53] = True
    known = np.sqrt(np.einsum("tkk->tk", uncertainty(times, positions, unsure)))
    assert known[0].tolist() == [0] * 6
    assert (known[52, :3] > known[49, :3] + 5).all() and (known[52, 3:] > known[49, 3:] + 0.05).all()
