"""Confidence bounds of a share, such as a loss rate, and how many trials show whether it meets a limit."""

from __future__ import annotations

import math

CONFIDENCE = 0.95
"""Probability with which the true share is not below its lower bound, and not above its upper bound."""
GROWTH = 1.1
MAX_TRIALS = 1e10


def share_bounds(events: int, trials: int) -> tuple[float, float]:
    """Lower and upper confidence bound of the share of events (Clopper and Pearson, 1934; one-sided each)."""
    from scipy.special import betaincinv

    low = 0.0 if events == 0 else float(betaincinv(events, trials - events + 1, 1 - CONFIDENCE))
    high = 1.0 if events >= trials else float(betaincinv(events + 1, trials - events, CONFIDENCE))
    return low, high


def trials_needed(limit: float, expected: float) -> float:
    """Number of trials after which the bounds of a share should be on one side of a limit; infinite: never.

    Args:
        limit: largest permitted share.
        expected: share that is expected; one standard deviation of its events is added as a margin.
    """
    if limit <= 0:
        return math.inf if expected == 0 else 3 / expected
    trials = 1 / limit
    while trials < MAX_TRIALS:
        count, mean = math.ceil(trials), trials * expected
        if expected <= limit:
            decided = share_bounds(math.ceil(mean + math.sqrt(mean)), count)[1] <= limit
        else:
            decided = share_bounds(max(0, math.floor(mean - math.sqrt(mean))), count)[0] > limit
        if decided:
            return count
        trials *= GROWTH
    return math.inf
