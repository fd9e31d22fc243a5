"""Trackers of features through frames: one file for each backend, found by its name (`pipeline.core.plugins`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.types import F64, I64, U8, Bools
from scan2sim.slam.features import Features
from scan2sim.slam.matchers import Matcher
from scan2sim.slam.odometry.virtual_cameras import Facets


@dataclass
class Tracks:
    """Features that are followed.

    Attributes:
        ids: (N,) numbers that stay a feature's own.
        bearing: (N, 3) unit, in the axes of the last frame's camera.
    """

    ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    bearing: F64 = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.ids)

    def keep(self, mask: Bools) -> Tracks:
        """Those that `mask` (N,) selects."""
        return Tracks(self.ids[mask], self.bearing[mask])


class Tracker(Protocol):
    """A backend that has begun.

    Attributes:
        tracks: of the last frame.
        pictures: facets of the last frame.
    """

    tracks: Tracks
    pictures: list[U8]

    def track(self, grey: U8, expected: F64 | None = None) -> float:
        """Follow all tracks into the next frame; returns the share that could be followed.

        Args:
            grey: (H, W).
            expected: (N, 3) bearings where they are probably seen now.
        """

    def drop(self, ids: I64) -> None:
        """Don't follow these any more."""

    def refill(self) -> int:
        """Find features where few are followed; how many."""


class Backend(Protocol):
    """What a backend's module has."""

    def load(
        self, facets: Facets, mask: U8 | None, count: int, features: Features | None, matcher: Matcher | None
    ) -> Tracker:
        """See `named`."""


def named(
    name: str,
    facets: Facets,
    mask: U8 | None,
    count: int,
    features: Features | None = None,
    matcher: Matcher | None = None,
) -> Tracker:
    """A backend.

    Args:
        name: of its file here.
        facets: of the frames.
        mask: (H, W), 0 where the car itself is; None: nowhere.
        count: features to keep alive.
        features, matcher: for a backend that finds features and matches them.

    Raises:
        SettingError: there is none of that name, or it lacks features or a matcher, or they don't fit.
        UnavailableError: it can't run here.
    """
    backend: Backend = plugins.find(__name__, name, "slam.tracker")
    return backend.load(facets, mask, count, features, matcher)
