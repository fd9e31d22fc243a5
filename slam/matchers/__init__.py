"""Feature matchers. Each backend is a module in this package, loaded by its name (`pipeline.core.plugins`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import I64
from scan2sim.slam.features import Features, FeatureSet
from scan2sim.slam.weights import Weights

Sizes = tuple[tuple[int, int], tuple[int, int]]


class Matcher(Protocol):
    """Interface of a matcher.

    Attributes:
        name: name of the backend.
        takes: name of the feature backend that it was trained for; None: any.
        dimension: dimension of the descriptors that it was trained for; None: any.
    """

    name: str
    takes: str | None
    dimension: int | None

    def match(self, a: FeatureSet, b: FeatureSet, sizes: Sizes) -> I64:
        """(M, 2) rows in a and b of matching features, each row at most once.

        Args:
            a, b: features of two images.
            sizes: (width, height) of both images.
        """

    def describe(self) -> str:
        """Description for logs, with hash and licence of the weights."""


class NetworkMatcher(ABC):
    """Base class of neural matchers: matches are mutual maxima of the match probability, above a threshold.

    Attributes:
        probability_min: least probability of a match, as published.
    """

    probability_min: float

    def __init__(self, weights: Weights) -> None:
        self.weights = weights

    @abstractmethod
    def probabilities(self, a: FeatureSet, b: FeatureSet, sizes: Sizes) -> Any:
        """Tensor (N, M) of match probabilities."""

    def match(self, a: FeatureSet, b: FeatureSet, sizes: Sizes) -> I64:
        """See `Matcher`."""
        import torch

        if not len(a.uv) or not len(b.uv):
            return np.zeros((0, 2), np.int64)
        with torch.inference_mode():
            return mutual(self.probabilities(a, b, sizes), self.probability_min)

    def describe(self) -> str:
        """See `Matcher`."""
        return self.weights.describe()


class Backend(Protocol):
    """Interface of a backend's module."""

    def load(self, weights: Path | None, device: str) -> Matcher:
        """See `named`."""


def named(name: str, weights: Path | None = None, *, device: str = "auto") -> Matcher:
    """Load the matcher backend of a name.

    Args:
        name: name of the backend's module in this package.
        weights: the user's weights file, for networks.
        device: torch device, for networks.

    Raises:
        SettingError: there is no such backend, or weights are missing, or given to a backend without any.
        UnavailableError: a package that it needs isn't installed.
        InputError: the weights are damaged, of another network, or unsafe to read.
    """
    backend: Backend = plugins.find(__name__, name, "track.matcher")
    return backend.load(weights, device)


def check(features: Features, matcher: Matcher) -> None:
    """Raise SettingError unless a matcher can match these features."""
    name_fits = matcher.takes in (None, features.name)
    if not name_fits or matcher.dimension not in (None, features.dimension):
        expected = f"{matcher.takes or 'descriptors'} of {matcher.dimension} numbers"
        given = f"{features.name} of {features.dimension} {'bytes' if features.binary else 'numbers'}"
        raise SettingError(
            "track.matcher", f"{matcher.name!r} was made for {expected}, not for {given}",
            "Choose another matcher or other features; the matcher `nearest` takes any",
        )  # fmt: skip


def mutual(scores: Any, score_min: float) -> I64:
    """(M, 2) rows and columns of a score tensor (N, M) that are mutual maxima and above `score_min`."""
    import torch

    best, column_of = scores.max(dim=1)
    row_of = scores.argmax(dim=0)
    rows = torch.arange(len(column_of), device=scores.device)
    good = (row_of[column_of] == rows) & (best > score_min)
    return np.asarray(torch.stack([rows[good], column_of[good]], dim=1).cpu().numpy(), np.int64)
