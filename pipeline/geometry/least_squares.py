"""Kernels of nonlinear least squares (Gauss-Newton): pose updates, robust weights, block-sparse and banded systems.

An update of a pose is its position (metres) and rotation vector (radians), both about world axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64, I64


def skew(v: F64) -> F64:
    """Skew-symmetric matrices (..., 3, 3) of vectors v (..., 3): the product with w is v x w."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def moved(poses: F64, by: F64) -> F64:
    """Poses (N, 4, 4) after an update (N, 6) of position and rotation about world axes (retraction)."""
    from scipy.spatial.transform import Rotation

    out = poses.copy()
    out[:, :3, 3] += by[:, :3]
    out[:, :3, :3] = Rotation.from_rotvec(by[:, 3:]).as_matrix() @ out[:, :3, :3]
    return out


def cauchy_weights(residual: F64, scale: float) -> F64:
    """(K,) weights by the Cauchy loss, of residuals (K, M); `scale`: squared length at which the weight is one half."""
    return np.asarray(1 / (1 + (residual**2).sum(axis=1) / scale), np.float64)


def block_jacobian(blocks: F64, variables: I64, count: int) -> Any:
    """Sparse (K M, count S) Jacobian of K factors with M residuals each.

    Args:
        blocks: (K, V, M, S) derivatives by the V variables of each factor.
        variables: (K, V) their indices.
        count: number of variables, of S parameters each.
    """
    from scipy.sparse import bsr_array

    K, V, M, S = blocks.shape
    parts = blocks.reshape(-1, M, S), variables.ravel(), np.arange(0, K * V + 1, V)
    return bsr_array(parts, shape=(K * M, count * S))


def block_diagonal(blocks: F64) -> Any:
    """Sparse (K S, K S) matrix of blocks (K, S, S) on the diagonal."""
    index = np.arange(len(blocks))
    return block_jacobian(blocks[:, None], index[:, None], len(blocks))


def solve_block_tridiagonal(D: F64, above: F64, b: F64) -> F64:
    """(N, S) solution of a positive definite block-tridiagonal system, by banded Cholesky factorization.

    Args:
        D: (N, S, S) blocks on the diagonal.
        above: (N - 1, S, S) blocks above it.
        b: (N, S) right-hand side.
    """
    from scipy.linalg import solveh_banded

    n, size = b.shape
    band = np.zeros((2 * size, n * size))
    row, column = np.indices((size, size))
    upper = row <= column
    first = size * np.arange(n)[:, None]
    band[(2 * size - 1 + row - column)[upper], first + column[upper]] = D[:, row[upper], column[upper]]
    band[(size - 1 + row - column).ravel(), first[1:] + column.ravel()] = above.reshape(n - 1, -1)
    return np.asarray(solveh_banded(band, b.ravel())).reshape(-1, size)


def block_tridiagonal_marginals(D: F64, above: F64) -> F64:
    """(N, S, S) blocks on the diagonal of a block-tridiagonal matrix's inverse: marginal covariances (Takahashi).

    Takes time linear in N. Arguments as of `solve_block_tridiagonal`.
    """
    left = np.empty_like(D)
    left[0] = D[0]
    for k in range(1, len(D)):
        left[k] = D[k] - above[k - 1].T @ np.linalg.solve(left[k - 1], above[k - 1])
    out = np.asarray(np.linalg.inv(left), np.float64)
    for k in range(len(D) - 2, -1, -1):
        G = out[k] @ above[k]
        out[k] += G @ out[k + 1] @ G.T
    return out
