"""Matchers: which features of two pictures are the same. A file a backend, found by its name.

A backend's module has `available() -> str | None` (what to install, if it can't run here) and
`load(weights, device) -> Matcher`.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.errors import SettingError
from scan2sim.pipeline.extras import unavailable
from scan2sim.slam.features import Features, Found

I64 = npt.NDArray[np.int64]
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


def names() -> list[str]:
    """Of the backends that there are."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def missing(name: str) -> str | None:
    """What to install so that a backend can run here, or None."""
    found: str | None = _module(name).available()
    return found


def named(name: str, weights: Path | None = None, *, device: str = "auto") -> Matcher:
    """A backend.

    Args:
        name: one of `names()`.
        weights: the user's file, for networks.
        device: of torch, for networks.

    Raises:
        SettingError: there is no such backend, or it wants weights, or none.
        UnavailableError: it can't run here.
        InputError: the weights are damaged, of another network, or unsafe to read.
    """
    module = _module(name)
    lacking = module.available()
    if lacking:
        raise unavailable(f"slam.matchers {name}", lacking)
    backend: Matcher = module.load(weights, device)
    return backend


def check(features: Features, matcher: Matcher) -> None:
    """Raise SettingError unless a matcher can match these features."""
    named_so = matcher.takes in (None, features.name)
    if not named_so or matcher.dimension not in (None, features.dimension):
        made_for = f"{matcher.takes or 'features'} of {matcher.dimension} numbers"
        given = f"{features.name} of {features.dimension} {'bytes' if features.binary else 'numbers'}"
        raise SettingError(
            "slam.matcher", f"{matcher.name!r} was made for {made_for}, not for {given}",
            "Choose others, or `nearest`, which takes any",
        )  # fmt: skip


def _module(name: str) -> Any:
    if name not in names():
        raise SettingError("slam.matcher", f"there is no {name!r}", f"Choose one of: {', '.join(names())}")
    return importlib.import_module(f"scan2sim.slam.matchers.{name}")


def mutual(scores: Any, least: float) -> I64:
    """(M, 2) rows and columns of a tensor (N, M) that are each other's largest, and above `least`."""
    import torch

    best, there = scores.max(dim=1)
    back = scores.argmax(dim=0)
    rows = torch.arange(len(there), device=scores.device)
    good = (back[there] == rows) & (best > least)
    return np.asarray(torch.stack([rows[good], there[good]], dim=1).cpu().numpy(), np.int64)
