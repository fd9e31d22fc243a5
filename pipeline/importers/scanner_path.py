"""Path of a moving scanner: its pose at any time, and which times have a reliable one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.poses import interpolate
from scan2sim.pipeline.core.types import F32, F64, Bools

MAX_POSE_GAP_S = 1.0
"""Time between two poses up to which poses are interpolated (or three times the usual interval, if that is longer)."""


class ScannerPath:
    """Poses of the scanner, with gaps and unsure sections.

    Args:
        times: (T,) seconds, ascending.
        T: (T, 4, 4) scanner to local coordinates.
        unsure: (T,) whether a pose is unreliable (dead-reckoned); None: all are reliable.
    """

    def __init__(self, times: F64, T: F64, unsure: Bools | None = None) -> None:
        self.times, self.T = times, T
        steps = np.diff(times)
        self.median_step = float(np.median(steps)) if len(steps) else 0.0
        gaps = steps > max(MAX_POSE_GAP_S, 3 * self.median_step)
        self._unsure = np.concatenate([[0], np.cumsum(np.zeros(len(times), bool) if unsure is None else unsure)])
        self._gaps = np.concatenate([[0], np.cumsum(gaps)])

    def at(self, times: F64) -> F64:
        """Interpolated poses (N, 4, 4), scanner to local coordinates."""
        low = max(0, int(np.searchsorted(self.times, times.min())) - 2)
        high = int(np.searchsorted(self.times, times.max())) + 2
        return interpolate(self.T[low:high], self.times[low:high], times)

    def to_local(self, xyz: F32, times: F64) -> F64:
        """Points (N, 3) in scanner axes, measured at `times` (N,), in local coordinates."""
        if not len(xyz):
            return np.zeros((0, 3))
        poses = self.at(times if np.ptp(times) else times[:1])
        return np.einsum("nij,nj->ni", poses[:, :3, :3], xyz) + poses[:, :3, 3]

    def usable(self, times: F64, half_period: float, what: str, poses: Path, warn: Callable[[str], None]) -> Bools:
        """Whether there are poses (N,) for all of `times` -+ `half_period`; warns about times without.

        Raises:
            InputError: no time has a pose. DataError: all poses are unsure.
        """
        tolerance = self.median_step / 2 + 1e-6
        within = (times >= self.times[0] - tolerance) & (times <= self.times[-1] + tolerance)
        if not within.any():
            raise InputError(
                poses,
                f"has times from {self.times[0]:.2f} to {self.times[-1]:.2f} s, the {what} from {times.min():.2f} to "
                f"{times.max():.2f} s",
                "Give times in the trajectory's clock, or --time-offset",
            )
        last = len(self.times) - 1
        first = np.clip(np.searchsorted(self.times, times - half_period, "right") - 1, 0, last)
        end = np.clip(np.searchsorted(self.times, times + half_period, "left"), 0, last)
        gap = self._gaps[end] - self._gaps[first] > 0
        unsure = self._unsure[end + 1] - self._unsure[first] > 0
        reasons = (
            (~within, "outside the trajectory's times"),
            (within & gap, "in gaps of the trajectory"),
            (within & ~gap & unsure, "where its poses are unsure (--keep-unsure keeps them)"),
        )
        for bad, reason in reasons:
            if bad.any():
                warn(f"{int(bad.sum())} of {what} are excluded: {reason}")
        good = within & ~gap & ~unsure
        if not good.any():
            remedy = "Check where tracking was lost, or use --keep-unsure"
            raise DataError(poses, f"none of {what} has a reliable pose", remedy)
        return good
