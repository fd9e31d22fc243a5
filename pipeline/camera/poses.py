"""Poses: between others, and with rotations whose digits were rounded."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


def interpolate(poses: F64, at: F64, times: F64) -> F64:
    """(N, 4, 4) poses at `times` (N,), by the motion between neighbours; beyond the ends it goes on.

    Positions move straight from pose to pose, rotations turn evenly about one axis (slerp: Shoemake 1985).

    Args:
        poses: (T, 4, 4), at least one.
        at: (T,) their times, ascending.
    """
    from scipy.spatial.transform import Rotation

    if len(poses) == 1:
        return np.repeat(poses, len(times), axis=0)
    b = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    a = b - 1
    span = at[b] - at[a]
    share = np.divide(times - at[a], span, out=np.zeros(len(times)), where=span > 0)[:, None]
    turn = Rotation.from_matrix(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]).as_rotvec()[a]
    out = np.tile(np.eye(4), (len(times), 1, 1))
    out[:, :3, :3] = poses[a, :3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    out[:, :3, 3] = poses[a, :3, 3] + share * (poses[b, :3, 3] - poses[a, :3, 3])
    return out


def nearest_rotation(R: F64) -> F64:
    """The rotations nearest to matrices (..., 3, 3) that are rotations but for rounding."""
    u, _, vt = np.linalg.svd(R)
    return np.asarray(u @ vt, np.float64)
