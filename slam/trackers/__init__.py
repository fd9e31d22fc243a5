"""Feature trackers. Each backend is a module in this package, loaded by its name (`pipeline.core.plugins`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.types import F64, I64, U8, Bools
from scan2sim.slam.features import Features
from scan2sim.slam.matchers import Matcher
from scan2sim.slam.virtual_cameras import VirtualViews


@dataclass
class Tracks:
    """Tracked features.

    Attributes:
        ids: (N,) ids, unique and constant over the life of a track.
        bearing: (N, 3) unit vectors, in the axes of the last frame's camera.
    """

    ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    bearing: F64 = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.ids)

    def keep(self, mask: Bools) -> Tracks:
        """Tracks selected by `mask` (N,)."""
        return Tracks(self.ids[mask], self.bearing[mask])


class Tracker(Protocol):
    """Interface of a tracker.

    Attributes:
        tracks: tracks in the last frame.
        images: virtual views of the last frame.
    """

    tracks: Tracks
    images: list[U8]

    def track(self, grey: U8, expected: F64 | None = None) -> float:
        """Track all features into the next frame; returns the share that was tracked.

        Args:
            grey: (H, W) next frame.
            expected: (N, 3) predicted bearings of the tracks.
        """

    def drop(self, ids: I64) -> None:
        """Stop tracking these ids."""

    def refill(self) -> int:
        """Detect new features where there are few tracks; returns how many were added."""


class Backend(Protocol):
    """Interface of a backend's module."""

    def load(
        self, views: VirtualViews, mask: U8 | None, count: int, features: Features | None, matcher: Matcher | None
    ) -> Tracker:
        """See `named`."""


def named(
    name: str,
    views: VirtualViews,
    mask: U8 | None,
    count: int,
    features: Features | None = None,
    matcher: Matcher | None = None,
) -> Tracker:
    """Load the tracker backend of a name.

    Args:
        name: name of the backend's module in this package.
        views: virtual views of the frames.
        mask: (H, W) ego-vehicle mask, 0 where the car itself is visible; None: nowhere.
        count: number of features to track.
        features, matcher: feature detector and matcher, for backends that use them.

    Raises:
        SettingError: there is no such backend, or its features or matcher are missing or don't fit each other.
        UnavailableError: a package that it needs isn't installed.
    """
    backend: Backend = plugins.find(__name__, name, "slam.tracker")
    return backend.load(views, mask, count, features, matcher)
