"""Up direction of a model from how its cameras were held: their horizontal axes are level, however they are pitched."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import F64

MAX_ROLL_DEG = 15.0
"""Deviation of a camera's horizontal axis from level at which it counts half."""
MIN_TURN_DEG = 10.0
"""Spread of the horizontal axes from which they determine the direction; of a straight drive they don't."""
ROUNDS = 20


def up_of_photos(rotations: F64) -> F64:
    """Unit direction (3,) that is most orthogonal to the photos' horizontal axes, upwards in most of them.

    Photos in portrait format, turned by a quarter, count by their other axis. If all cameras look in one direction,
    only the roll is known: up is orthogonal to the horizontal axis and nearest to the mean up direction.

    Args:
        rotations: (P, 3, 3) camera (x right, y down, z ahead) to model.
    """
    across, ups = rotations[:, :, 0], -rotations[:, :, 1]
    up = _unit(ups.mean(axis=0))
    for _ in range(ROUNDS):
        upright = np.abs(across @ up) <= np.abs(ups @ up)
        level = np.where(upright[:, None], across, ups)
        roll = np.degrees(np.arcsin(np.clip(np.abs(level @ up), 0, 1)))
        weight = 1 / (1 + (roll / MAX_ROLL_DEG) ** 2)
        spread, axes = np.linalg.eigh((weight[:, None] * level).T @ level / weight.sum())
        if np.sqrt(max(spread[1], 0.0)) > np.sin(np.radians(MIN_TURN_DEG)):
            found = axes[:, 0]
        else:
            found = _unit(up - axes[:, 2] * (axes[:, 2] @ up))
        up = found if found @ ups.mean(axis=0) > 0 else -found
    return up


def _unit(vector: F64) -> F64:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
