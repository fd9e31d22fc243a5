"""Gauss-Newton kernels: sparse and banded systems equal dense ones."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.geometry.least_squares import (
    block_jacobian,
    block_tridiagonal_marginals,
    solve_block_tridiagonal,
)


def test_block_tridiagonal_systems_equal_dense_ones() -> None:
    rng, n, size = np.random.default_rng(0), 5, 10
    dense = rng.normal(size=(n * size, n * size))
    dense = dense @ dense.T + 50 * np.eye(n * size)
    for i in range(n):
        for j in range(n):
            if abs(i - j) > 1:
                dense[i * size : (i + 1) * size, j * size : (j + 1) * size] = 0
    dense += 200 * np.eye(n * size)
    blocks = dense.reshape(n, size, n, size).transpose(0, 2, 1, 3)
    D, above = blocks[np.arange(n), np.arange(n)], blocks[np.arange(n - 1), np.arange(1, n)]
    b = rng.normal(size=(n, size))
    np.testing.assert_allclose(
        solve_block_tridiagonal(D, above, b).ravel(), np.linalg.solve(dense, b.ravel()), rtol=1e-9
    )
    inverted = np.linalg.inv(dense).reshape(n, size, n, size).transpose(0, 2, 1, 3)
    np.testing.assert_allclose(
        block_tridiagonal_marginals(D, above), inverted[np.arange(n), np.arange(n)], rtol=1e-9, atol=1e-15
    )


def test_sparse_jacobian_equals_dense_one() -> None:
    rng, variables = np.random.default_rng(1), np.array([[0, 3], [2, 1], [3, 2]])
    blocks = rng.normal(size=(3, 2, 4, 6))
    dense = np.zeros((3, 4, 4, 6))
    for factor, of in enumerate(variables):
        for block, variable in zip(blocks[factor], of, strict=True):
            dense[factor, :, variable] = block
    np.testing.assert_array_equal(block_jacobian(blocks, variables, 4).toarray(), dense.reshape(12, 24))
