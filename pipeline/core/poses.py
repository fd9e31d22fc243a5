"""Poses: interpolation, and orthonormalization of rounded rotation matrices."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


def interpolate(poses: F64, at: F64, times: F64) -> F64:
    """Interpolated poses (N, 4, 4) at `times` (N,); beyond the ends, the first or last motion is extrapolated.

    Positions are interpolated linearly, rotations by slerp (Shoemake 1985).

    Args:
        poses: (T, 4, 4), at least one.
        at: (T,) times of the poses, ascending.
        times: (N,) times to interpolate at.
    """
    from scipy.spatial.transform import Rotation

    if len(poses) == 1:
        return np.repeat(poses, len(times), axis=0)
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    before = after - 1
    span = at[after] - at[before]
    fraction = np.divide(times - at[before], span, out=np.zeros(len(times)), where=span > 0)[:, None]
    rotvec = Rotation.from_matrix(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]).as_rotvec()[before]
    out = np.tile(np.eye(4), (len(times), 1, 1))
    out[:, :3, :3] = poses[before, :3, :3] @ Rotation.from_rotvec(fraction * rotvec).as_matrix()
    out[:, :3, 3] = poses[before, :3, 3] + fraction * (poses[after, :3, 3] - poses[before, :3, 3])
    return out


def nearest_rotation(R: F64) -> F64:
    """Rotation matrices (..., 3, 3) nearest to rounded rotation matrices (polar decomposition by SVD)."""
    u, _, vt = np.linalg.svd(R)
    return np.asarray(u @ vt, np.float64)
