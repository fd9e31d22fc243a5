"""Marginalization: information matrix of all keyframes' poses, their points eliminated, and the covariance from it.

When a keyframe leaves the window, the points that it observes are marginalized (Schur complement), and the resulting
6 x 6 blocks are added to a block-banded matrix as wide as the window. At the end it is the normal matrix of the whole
graph, from which every keyframe's covariance follows block by block (Takahashi's recursion, as in a smoother), in time
linear in the length of the drive.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64, I64
from scan2sim.pipeline.geometry.least_squares import block_tridiagonal_marginals
from scan2sim.slam.geometry import lever_arm_jacobian


class MotionSigma(NamedTuple):
    """Standard deviation of the motion from one keyframe to the next, per axis of translation and of rotation."""

    metres: float
    radians: float


class Information:
    """Information matrix of the keyframes' poses, per squared radian of a bearing.

    Attributes:
        blocks: per keyframe (B, 6, 6) blocks with itself and with its predecessors; metres and radians, world axes.
        squares: sum of squared reprojection errors, radians.
        freedom: degrees of freedom of these errors.
    """

    STATE = ("blocks", "squares", "freedom", "_added", "_until")

    def __init__(self, width: int) -> None:
        """`width`: number of consecutive keyframes that may observe a common point."""
        self._width = width
        self.blocks: list[F64] = []
        self.squares, self.freedom = 0.0, 0
        # ids of added points, and for each the last keyframe whose observation was included
        self._added, self._until = np.zeros(0, np.int64), np.zeros(0, np.int64)

    def not_added(self, ids: I64, keyframe: int) -> I64:
        """Those of the points (N,) whose observation by a keyframe isn't included yet."""
        return ids[~np.isin(ids, self._added[self._until >= keyframe])]

    def add(self, which: Sequence[int], ids: I64, reduced: F64, errors: F64) -> None:
        """Add the information of marginalized points.

        Args:
            which: (C,) consecutive keyframes, no more than the width.
            ids: (N,) ids of the points.
            reduced: (6 C, 6 C) their information on the keyframes' poses, after the Schur complement.
            errors: (O,) reprojection errors of their observations, radians.
        """
        while len(self.blocks) <= which[-1]:
            self.blocks.append(np.zeros((self._width, 6, 6)))
        for i, k in enumerate(which):
            for j in range(i + 1):
                self.blocks[k][i - j] += reduced[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
        self.squares += float((errors**2).sum())
        self.freedom += max(2 * len(errors) - 3 * len(ids), 0)
        alive = self._until > which[0]
        self._added = np.concatenate([self._added[alive], ids])
        self._until = np.concatenate([self._until[alive], np.full(len(ids), which[-1])])

    def rescale(self, first: int, factor: float) -> None:
        """Adapt the blocks to a scaling of the keyframes from `first` on by a factor."""
        scale = np.repeat([1 / factor, 1.0], 3)
        for k in range(first, len(self.blocks)):
            self.blocks[k][: k - first + 1] *= scale[:, None] * scale

    def noise(self, default: float) -> float:
        """Standard deviation of a bearing estimated from the errors, radians; `default` without errors."""
        return float(np.sqrt(self.squares / self.freedom)) if self.freedom > 0 and self.squares > 0 else default

    def covariance(
        self,
        poses: F64,
        motions: Sequence[MotionSigma],
        baselines: Sequence[tuple[int, float]],
        fixes: F64,
        sigma: float,
    ) -> F64:
        """(C, 6, 6) covariance of the keyframes' poses, position (m) and rotation (rad), about world axes.

        Args:
            poses: (C, 4, 4) camera to world.
            motions: (C,) standard deviations of the motion from the previous keyframe; for the first: from the world.
            baselines: keyframes whose distance to the next one is known, with its relative standard deviation.
            fixes: (C,) standard deviation of a position measurement (GPS), metres; infinite: there is none.
            sigma: standard deviation of a bearing if there are no errors to estimate it from, radians.
        """
        A = _Band(len(poses), self._width)
        for k, blocks in enumerate(self.blocks[: len(poses)]):
            for back in range(min(self._width, k + 1)):
                A.add(k, k - back, blocks[back] / self.noise(sigma) ** 2)
        for k, metres in enumerate(fixes):
            A.add(k, k, np.diag(np.repeat([metres**-2.0, 0.0], 3)))
        for k, motion in enumerate(motions):
            weight = np.diag(np.repeat([motion.metres**-2.0, motion.radians**-2.0], 3))
            if k == 0:
                A.add(0, 0, weight)
                continue
            # a rotation of the previous keyframe also moves this one, by the lever arm
            lever = lever_arm_jacobian(poses[k, :3, 3] - poses[k - 1, :3, 3])
            A.couple(k, k - 1, np.eye(6), -lever, weight)
        for k, share in baselines:
            baseline = poses[k + 1, :3, 3] - poses[k, :3, 3]
            length = float(np.linalg.norm(baseline))
            if length > 0:
                J = np.concatenate([baseline / length, np.zeros(3)])[None]
                A.couple(k + 1, k, J, -J, np.array([[(share * length) ** -2.0]]))
        return A.marginals()


class _Band:
    """Symmetric block-banded matrix of 6 x 6 blocks, stored as dense blocks of `width` keyframes."""

    def __init__(self, count: int, width: int) -> None:
        self.count, self.width = count, min(width, count)
        parts, size = -(-count // self.width), 6 * self.width
        self.diagonal, self.below = np.zeros((parts, size, size)), np.zeros((parts, size, size))

    def add(self, row: int, column: int, block: F64) -> None:
        """Add a block and its transpose; `column` must not exceed `row`."""
        (a, i), (b, j) = divmod(row, self.width), divmod(column, self.width)
        rows, columns = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
        if a != b:
            self.below[a][rows, columns] += block
            return
        self.diagonal[a][rows, columns] += block
        if row != column:
            self.diagonal[a][columns, rows] += block.T

    def couple(self, row: int, column: int, J: F64, K: F64, weight: F64) -> None:
        """Add a factor with Jacobians J, K of two keyframes."""
        self.add(row, row, J.T @ weight @ J)
        self.add(column, column, K.T @ weight @ K)
        self.add(row, column, J.T @ weight @ K)

    def marginals(self) -> F64:
        """(C, 6, 6) diagonal blocks of the inverse."""
        parts, size = self.diagonal.shape[:2]
        padding = np.arange(6 * self.count - (parts - 1) * size, size)
        self.diagonal[-1][padding, padding] = 1.0
        known = block_tridiagonal_marginals(self.diagonal, self.below[1:].transpose(0, 2, 1))
        blocks = known.reshape(parts, self.width, 6, self.width, 6)
        own = np.einsum("piajb->piajb", blocks)[:, np.arange(self.width), :, np.arange(self.width)]
        return np.ascontiguousarray(own.transpose(1, 0, 2, 3).reshape(-1, 6, 6)[: self.count])
