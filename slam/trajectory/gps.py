"""Smoothing, noise and clocks of GPS tracks; `pipeline.io.gps` reads them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from scan2sim.pipeline.core.types import F64, GpsTrack

ABSOLUTE_S = 1e8
"""Times above this count from 1970, others from the start of a recording."""
NEAR_S = 3600.0
"""Time by which a video may begin before its GPS track, seconds."""
ZONES_S = 900.0 * np.arange(-56, 57)
"""Time zones: seconds that local time is ahead of UTC."""


def video_clock(track: GpsTrack, start: float, warn: Callable[[str], None]) -> GpsTrack:
    """A track with UNIX times in a video's time, which counts from its first frame.

    The video's start lies within the track, by UTC or, as action cameras write it, by local time. Otherwise the first
    frame is assumed to be at the first fix. `warn` receives what was assumed.

    Args:
        track: the track.
        start: UNIX time of the first frame by the video's metadata.
        warn: receives a warning.
    """
    first, last = float(track.times[0]), float(track.times[-1])
    if first - NEAR_S < start < max(last, first + NEAR_S):
        return track.shifted(-start)
    zones = ZONES_S[(start - ZONES_S >= first) & (start - ZONES_S <= last)]
    if len(zones) == 1:
        warn(f"the video's clock is assumed to be {zones[0] / 3600:+g} h from UTC (see --gps-offset)")
        return track.shifted(float(zones[0]) - start)
    began, covered = _date(start), f"{_date(first)} to {_date(last)}"
    warn(
        f"the video's start by its metadata ({began}) isn't within the GPS track ({covered}): its first frame is "
        "assumed to be at the first fix (see --gps-offset)"
    )
    return track.shifted(-first)


def _date(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S} UTC"


def smooth(track: GpsTrack, seconds: float = 1.0, max_gap: float = 3.0) -> GpsTrack:
    """Smooth a track by a robust local parabola around every fix; gaps over `max_gap` seconds aren't bridged.

    LOWESS (Cleveland 1979) of degree 2: neighbours are weighted by a Gaussian of `seconds`, and outliers are
    down-weighted. `sigma` stays unchanged: a receiver's error is almost constant over seconds.
    """
    positions, leverage = _lowess(track, seconds, max_gap)
    return replace(track, positions=positions, scatter=noise(track) * float(np.sqrt(np.median(leverage))))


def noise(track: GpsTrack, seconds: float = 1.5, max_gap: float = 3.0) -> float:
    """Scatter of the fixes about their smoothed path: standard deviation of a horizontal axis, metres.

    Robust (median absolute deviation); includes errors that change within about 6 x `seconds`. Slower errors, the
    larger part of a receiver's, can't be distinguished from motion: this is a lower bound of the true error.
    """
    smoothed, leverage = _lowess(track, seconds, max_gap)
    free = leverage < 0.9  # at the ends of stretches, the fit follows the fixes
    scatter = (track.positions - smoothed)[free, :2] / np.sqrt(1 - leverage[free])[:, None]
    return float(1.4826 * np.median(np.abs(scatter))) if free.any() else 0.0


def _lowess(track: GpsTrack, seconds: float, max_gap: float, rounds: int = 3) -> tuple[F64, F64]:
    """(N, 3) smoothed positions, and (N,) leverage: the weight of each fix in its own smoothed position."""
    times, positions = track.times, track.positions
    n = len(times)
    stretch = np.concatenate([[0], np.cumsum(np.diff(times) > max_gap)])
    first, last = np.searchsorted(times, times - 3 * seconds), np.searchsorted(times, times + 3 * seconds)
    offsets = np.arange(int((last - first).max()))
    trust = np.ones(n) if track.sigma is None else (np.median(track.sigma) / np.maximum(track.sigma, 1e-3)) ** 2
    smoothed, leverage, robust = positions.copy(), np.zeros(n), np.ones(n)
    for _ in range(rounds):
        for block in np.array_split(np.arange(n), math.ceil(n * len(offsets) / 1e6)):
            near = np.minimum(first[block, None] + offsets, n - 1)
            inside = (first[block, None] + offsets < last[block, None]) & (stretch[near] == stretch[block, None])
            t = (times[near] - times[block, None]) / seconds
            weight = np.where(inside, np.exp(-0.5 * t * t) * trust[near] * robust[near], 0.0)
            basis = np.stack([np.ones_like(t), t, t * t], axis=-1)
            normal = np.einsum("bn,bni,bnj->bij", weight, basis, basis)
            normal += 1e-9 * np.eye(3) * np.maximum(weight.sum(axis=1), 1e-9)[:, None, None]  # fewer than three near
            ahead = positions[near] - positions[block, None]
            right = np.einsum("bn,bni,bnk->bik", weight, basis, ahead)
            inverse = np.linalg.inv(normal)
            smoothed[block] = positions[block] + np.einsum("bi,bik->bk", inverse[:, 0], right)
            leverage[block] = np.minimum(inverse[:, 0, 0] * trust[block] * robust[block], 1.0)
        own = np.linalg.norm((positions - smoothed)[:, :2], axis=1)
        left_out = own / np.maximum(1 - leverage, 0.05)  # leave-one-out residual
        scale = max(1.4826 * float(np.median(left_out)), 0.1)
        robust = np.maximum(1 - (left_out / (6 * scale)) ** 2, 1e-6) ** 2
    return smoothed, leverage
