"""Matchers of features between two images: one file for each backend, found by its name (`pipeline.core.plugins`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import I64
from scan2sim.slam.features import Features, Found
from scan2sim.slam.weights import Weights

Sizes = tuple[tuple[int, int], tuple[int, int]]


class Matcher(Protocol):
    """A backend that is loaded.

    Attributes:
        name: of the backend.
        takes: names of the features that it was made for; None: of any.
        dimension: of descriptors that it takes; None: any.
    """

    name: str
    takes: str | None
    dimension: int | None

    def match(self, a: Found, b: Found, sizes: Sizes) -> I64:
        """(M, 2) rows of a and of b that are the same, each at most once.

        Args:
            a, b: features of two pictures.
            sizes: (width, height) of either.
        """

    def describe(self) -> str:
        """What this is, for logs: with the hash and licence of weights."""


class ByNetwork(ABC):
    """What matchers by networks share: pairs are each other's most probable, and probable enough.

    Attributes:
        least: probability of a match, as published.
    """

    least: float

    def __init__(self, weights: Weights) -> None:
        self.weights = weights

    @abstractmethod
    def shares(self, a: Found, b: Found, sizes: Sizes) -> Any:
        """(N, M) probabilities of matches, a tensor."""

    def match(self, a: Found, b: Found, sizes: Sizes) -> I64:
        """See `Matcher`."""
        import torch

        if not len(a.uv) or not len(b.uv):
            return np.zeros((0, 2), np.int64)
        with torch.inference_mode():
            return mutual(self.shares(a, b, sizes), self.least)

    def describe(self) -> str:
        """See `Matcher`."""
        return self.weights.describe()


class Backend(Protocol):
    """What a backend's module has."""

    def load(self, weights: Path | None, device: str) -> Matcher:
        """See `named`."""


def named(name: str, weights: Path | None = None, *, device: str = "auto") -> Matcher:
    """A backend.

    Args:
        name: of its file here.
        weights: the user's file, for networks.
        device: of torch, for networks.

    Raises:
        SettingError: there is no such backend, or it wants weights, or none.
        UnavailableError: it can't run here.
        InputError: the weights are damaged, of another network, or unsafe to read.
    """
    backend: Backend = plugins.find(__name__, name, "track.matcher")
    return backend.load(weights, device)


def check(features: Features, matcher: Matcher) -> None:
    """Raise SettingError unless a matcher can match these features."""
    named_so = matcher.takes in (None, features.name)
    if not named_so or matcher.dimension not in (None, features.dimension):
        made_for = f"{matcher.takes or 'features'} of {matcher.dimension} numbers"
        given = f"{features.name} of {features.dimension} {'bytes' if features.binary else 'numbers'}"
        raise SettingError(
            "track.matcher", f"{matcher.name!r} was made for {made_for}, not for {given}",
            "Choose others, or `nearest`, which takes any",
        )  # fmt: skip


def mutual(scores: Any, least: float) -> I64:
    """(M, 2) rows and columns of a tensor (N, M) that are each other's largest, and above `least`."""
    import torch

    best, there = scores.max(dim=1)
    back = scores.argmax(dim=0)
    rows = torch.arange(len(there), device=scores.device)
    good = (back[there] == rows) & (best > least)
    return np.asarray(torch.stack([rows[good], there[good]], dim=1).cpu().numpy(), np.int64)
