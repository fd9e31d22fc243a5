"""Information: what all observations say of all keyframes, their points eliminated; the covariance that follows.

As keyframes leave the window, the points that they see are eliminated (Schur complement), and what remains is kept: a
band of 6 x 6 blocks, as wide as the window. In the end it is the normal matrix of the whole graph, from which every
keyframe's covariance follows block by block (Takahashi's recursion, as a smoother has it), however long the drive.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scan2sim.pipeline.core.types import F64, I64


class Tie(NamedTuple):
    """How far the motion from one keyframe to the next may be off, one standard deviation: each way, and each turn."""

    metres: float
    radians: float


class Information:
    """Of the poses of keyframes, per squared radian of a bearing.

    Attributes:
        blocks: (B, 6, 6) a keyframe: with itself, and with those before it; metres and radians, about world axes.
        squares: sum of squared errors of bearings, radians.
        freedom: how many independent errors these are.
    """

    STATE = ("blocks", "squares", "freedom", "_told", "_until")

    def __init__(self, width: int) -> None:
        """`width`: keyframes that a point may tie together."""
        self._width = width
        self.blocks: list[F64] = []
        self.squares, self.freedom = 0.0, 0
        self._told, self._until = np.zeros(0, np.int64), np.zeros(0, np.int64)  # points, and up to which keyframe

    def untold(self, ids: I64, keyframe: int) -> I64:
        """Of points (N,) that a keyframe sees, those whose sight of it hasn't been told yet."""
        return ids[~np.isin(ids, self._told[self._until >= keyframe])]

    def tell(self, which: Sequence[int], ids: I64, reduced: F64, errors: F64) -> None:
        """Points that have been eliminated.

        Args:
            which: (C,) keyframes in a row, no more than the width.
            ids: (N,) the points.
            reduced: (6 C, 6 C) what they say of the keyframes.
            errors: (O,) radians, of their observations.
        """
        while len(self.blocks) <= which[-1]:
            self.blocks.append(np.zeros((self._width, 6, 6)))
        for i, k in enumerate(which):
            for j in range(i + 1):
                self.blocks[k][i - j] += reduced[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
        self.squares += float((errors**2).sum())
        self.freedom += max(2 * len(errors) - 3 * len(ids), 0)
        alive = self._until > which[0]
        self._told = np.concatenate([self._told[alive], ids])
        self._until = np.concatenate([self._until[alive], np.full(len(ids), which[-1])])

    def rescale(self, first: int, factor: float) -> None:
        """Keyframes from `first` on have been moved apart by a factor."""
        scale = np.repeat([1 / factor, 1.0], 3)
        for k in range(first, len(self.blocks)):
            self.blocks[k][: k - first + 1] *= scale[:, None] * scale

    def noise(self, unless: float) -> float:
        """Radians of a bearing, one standard deviation, as the errors tell; `unless` where none do."""
        return float(np.sqrt(self.squares / self.freedom)) if self.freedom > 0 and self.squares > 0 else unless

    def covariance(
        self, poses: F64, ties: Sequence[Tie], chords: Sequence[tuple[int, float]], fixes: F64, sigma: float
    ) -> F64:
        """(C, 6, 6) of keyframes, position (m) and rotation (rad), about world axes.

        Args:
            poses: (C, 4, 4) camera to world.
            ties: (C,) of each to the one before it; the first's: to the world.
            chords: keyframes whose distance to the next one is known, and how well: standard deviation, a share of it.
            fixes: (C,) metres, standard deviation of what is known of each one's place besides; infinite: nothing.
            sigma: radians, of a bearing.
        """
        A = _Band(len(poses), self._width)
        for k, blocks in enumerate(self.blocks[: len(poses)]):
            for back in range(min(self._width, k + 1)):
                A.add(k, k - back, blocks[back] / self.noise(sigma) ** 2)
        for k, metres in enumerate(fixes):
            A.add(k, k, np.diag(np.repeat([metres**-2.0, 0.0], 3)))
        for k, tie in enumerate(ties):
            weight = np.diag(np.repeat([tie.metres**-2.0, tie.radians**-2.0], 3))
            if k == 0:
                A.add(0, 0, weight)
                continue
            # what the one before turns by moves this one along
            lever = np.eye(6)
            x, y, z = poses[k, :3, 3] - poses[k - 1, :3, 3]
            lever[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
            A.couple(k, k - 1, np.eye(6), -lever, weight)
        for k, share in chords:
            way = poses[k + 1, :3, 3] - poses[k, :3, 3]
            length = float(np.linalg.norm(way))
            if length > 0:
                J = np.concatenate([way / length, np.zeros(3)])[None]
                A.couple(k + 1, k, J, -J, np.array([[(share * length) ** -2.0]]))
        return A.marginals()


class _Band:
    """A symmetric matrix of 6 x 6 blocks near its diagonal, held as dense blocks of so many keyframes."""

    def __init__(self, count: int, width: int) -> None:
        self.count, self.step = count, min(width, count)
        parts, size = -(-count // self.step), 6 * self.step
        self.middle, self.below = np.zeros((parts, size, size)), np.zeros((parts, size, size))

    def add(self, row: int, column: int, block: F64) -> None:
        """Add a block, and its mirror image; `column` no larger than `row`."""
        (a, i), (b, j) = divmod(row, self.step), divmod(column, self.step)
        rows, columns = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
        if a != b:
            self.below[a][rows, columns] += block
            return
        self.middle[a][rows, columns] += block
        if row != column:
            self.middle[a][columns, rows] += block.T

    def couple(self, row: int, column: int, J: F64, K: F64, weight: F64) -> None:
        """Add a factor with Jacobians J, K of two keyframes."""
        self.add(row, row, J.T @ weight @ J)
        self.add(column, column, K.T @ weight @ K)
        self.add(row, column, J.T @ weight @ K)

    def marginals(self) -> F64:
        """(C, 6, 6) diagonal blocks of the inverse."""
        parts, size = self.middle.shape[:2]
        spare = np.arange(6 * self.count - (parts - 1) * size, size)
        self.middle[-1][spare, spare] = 1.0
        inverses = [np.linalg.inv(self.middle[0])]
        for a in range(1, parts):
            inverses.append(np.linalg.inv(self.middle[a] - self.below[a] @ inverses[-1] @ self.below[a].T))
        known = inverses[-1]
        out = [known]
        for a in range(parts - 1, 0, -1):
            back = inverses[a - 1] @ self.below[a].T
            known = inverses[a - 1] + back @ known @ back.T
            out.append(known)
        blocks = np.stack(out[::-1]).reshape(parts, self.step, 6, self.step, 6)
        own = np.einsum("piajb->piajb", blocks)[:, np.arange(self.step), :, np.arange(self.step)]
        return np.ascontiguousarray(own.transpose(1, 0, 2, 3).reshape(-1, 6, 6)[: self.count])
