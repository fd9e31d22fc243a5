"""Semantic segmentation of images (D3.2, section 5.4): SegFormer, or the networks that `segmentation` has besides."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE, colour_of
from scan2sim.pipeline.core.types import U8, Camera
from scan2sim.segmentation import backends
from scan2sim.segmentation.labels import CLASSES
from scan2sim.segmentation.photos import Classifier, class_map
from scan2sim.services.toolboxes import models
from scan2sim.services.toolboxes.results import Body, Segmentation
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.tasks import Facts, Follow

NEEDS = ("cv2", "onnxruntime")
SHADE = 0.55
"""Share of the classes' colours in what is drawn."""
OWN = "street"
"""The network that comes with weights."""


class Params(ToolboxParams):
    """Of semantic segmentation."""

    network: Annotated[
        str, Field(pattern=r"^[a-z]{1,20}$", description="street (the project's own), segformer, onnx.")
    ] = OWN
    width: Annotated[int, Field(ge=32, le=8192, description="Pixels; wider images are made smaller.")] = 1920
    field_of_view: Annotated[
        float, Field(ge=5, le=175, description="Degrees that images show from left to right (the own network alone).")
    ] = 80.0


def check(params: Params) -> None:
    """See `boxes.Toolbox`."""
    backends.check(params.network, _weights(params))


def load(params: Params) -> Segmenter:
    """The model (`boxes.Toolbox`)."""
    return Segmenter(params)


def follow(params: Params) -> Follow | None:
    """Images are segmented one by one."""
    return None


def draw(image: U8, body: Body) -> U8:
    """With its classes' colours over it."""
    import cv2

    assert body.segmentation
    mask = cv2.resize(mask_of(body.segmentation), image.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    codes = np.array([CODE.get(label, 0) for label in body.segmentation.labels], np.uint8)
    shaded: U8 = cv2.addWeighted(image, 1 - SHADE, colour_of()[codes[mask]], SHADE, 0)
    return shaded


def mask_of(segmentation: Segmentation) -> U8:
    """(H, W) classes' numbers of a result."""
    import cv2

    png = np.frombuffer(base64.b64decode(segmentation.mask), np.uint8)
    mask: U8 = cv2.imdecode(png, cv2.IMREAD_GRAYSCALE)
    return mask


def _weights(params: Params) -> Path | None:
    """The user's; None: the project's own."""
    own = params.network == OWN and params.weights is None
    return None if own else models.chosen(params, None)


class Segmenter:
    """See `boxes.Model`."""

    def __init__(self, params: Params) -> None:
        path = _weights(params)
        network = backends.load(params.network, path, params.device)
        self._classifier, self._params = Classifier(network, str(path or OWN)), params
        self.facts = Facts(network.facts.name, CLASSES, network.facts.sha256, network.facts.licence)

    def __call__(self, images: Sequence[U8]) -> list[Body]:
        """Classes of each image's pixels; several at once gain nothing."""
        return [Body(segmentation=self._segmented(image)) for image in images]

    def _segmented(self, image: U8) -> Segmentation:
        import cv2

        width = min(image.shape[1], self._params.width)
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        if width < image.shape[1]:
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        focal = width / 2 / math.tan(math.radians(self._params.field_of_view) / 2)
        camera = Camera("pinhole", width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        mask, _ = class_map(self._classifier.probabilities(image, camera), (height, width))
        count = np.bincount(mask.ravel(), minlength=len(CLASSES)) / mask.size
        _, png = cv2.imencode(".png", mask)
        return Segmentation(
            labels=CLASSES,
            shares={name: round(float(share), 4) for name, share in zip(CLASSES, count, strict=True) if share},
            mask=base64.b64encode(png.tobytes()).decode(),
            size=(width, height),
        )
