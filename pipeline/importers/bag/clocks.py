"""Check that the time stamps of a bag's topics are of one clock, by the times at which messages were recorded."""

from __future__ import annotations

from collections.abc import Collection

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.importers.bag.contents import Contents

MAX_DIFFERENCE_S = 2.0
"""Largest plausible difference between the delays of two topics, from time stamp to recording."""


def check_clocks(found: Contents, lidar: str, topics: Collection[str], links: Collection[tuple[str, str]]) -> None:
    """Check that topics and moving transforms have the clock of a lidar.

    A topic whose first message differs is checked again in the middle of the recording: a first message may be old.

    Args:
        found: contents of the bag.
        lidar: topic of the lidar.
        topics: the other topics that an import uses.
        links: moving transforms (parent, child) that it uses.

    Raises:
        InputError: one has another clock; names it and the difference.
    """
    if lidar not in found.lags:
        return
    suspect = [
        name for name in topics if abs(found.lags.get(name, found.lags[lidar]) - found.lags[lidar]) > MAX_DIFFERENCE_S
    ]
    for name in suspect:
        difference = _lag(found, lidar) - _lag(found, name)
        if abs(difference) > MAX_DIFFERENCE_S:
            raise _error(found, lidar, name, difference)
    for link in links:
        if link in found.link_lags:
            difference = _lag(found, lidar) - found.link_lags[link]
            if abs(difference) > MAX_DIFFERENCE_S:
                raise _error(found, lidar, f"the transform {link[0]} > {link[1]}", difference)


def _lag(found: Contents, topic: str) -> float:
    """Seconds from time stamp to recording: the smaller of the first messages and of one in the middle."""
    lags = [found.lags[topic]]
    for message in found.bag.messages([topic], share=0.5):
        stamp_ns = found.bag.header(message).stamp_ns
        if stamp_ns:
            lags.append((message.log_ns - stamp_ns) * 1e-9)
        break
    return min(lags, key=abs)


def _error(found: Contents, lidar: str, name: str, difference: float) -> InputError:
    side = "after" if difference > 0 else "before"
    cause = (
        f"has time stamps of two clocks: those of {name} are {abs(difference):,.1f} s {side} those of {lidar}, by the "
        "time of recording (37 s: TAI and UTC; 18 s: GPS and UTC; years: a sensor's time since its start)"
    )
    return InputError(found.bag.path, cause, "Use --stamps log, or leave the topic out (docs/rosbag.md)")
