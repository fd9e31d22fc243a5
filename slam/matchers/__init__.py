"""Feature matchers. Each backend is a module in this package, loaded by its name (`pipeline.core.plugins`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

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


class NetworkMatcher:
    """Base class of the matchers of `transformers`; they match mutual maxima of the match probability.

    Attributes:
        uses_scores: whether the network takes the scores of features.
    """

    uses_scores: bool

    def __init__(self, weights: Weights, network: Any) -> None:
        self.weights, self.network = weights, weights.set_in(network)

    def match(self, a: FeatureSet, b: FeatureSet, sizes: Sizes) -> I64:
        """See `Matcher`."""
        import torch
        from torch.nn.utils.rnn import pad_sequence

        if not len(a.uv) or not len(b.uv):
            return np.zeros((0, 2), np.int64)

        def batch(*of_images: npt.NDArray[Any]) -> Any:
            """(1, 2, N, ...) tensor of both images' values, with zeros after those of the image with fewer features."""
            values = [torch.from_numpy(x) for x in of_images]
            return pad_sequence(values, batch_first=True)[None].to(self.weights.device)

        # both images are scaled to a square of 2 x 2, as the network takes one size for both
        uv = [1 + (2 * x.uv - size) / max(size) for x, size in zip((a, b), sizes, strict=True)]
        inputs = {
            "keypoints": batch(*(x.astype(np.float32) for x in uv)),
            "descriptors": batch(a.descriptors, b.descriptors),
            "mask": batch(np.ones(len(a.uv), np.int32), np.ones(len(b.uv), np.int32)),
        }
        if self.uses_scores:
            inputs["scores"] = batch(a.scores, b.scores)
        with torch.inference_mode():
            # `forward` would detect features in both images again
            partner = self.network._match_image_pair(**inputs, height=2, width=2)[0].reshape(2, -1)[0].cpu().numpy()
        rows = np.flatnonzero(partner[: len(a.uv)] >= 0)
        return np.stack([rows, partner[rows]], axis=1).astype(np.int64)

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
        weights: the user's file or folder of weights, for networks.
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
