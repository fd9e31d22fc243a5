"""Semantic segmentation of images (D3.2, section 5.4): SegFormer or another network of the package `segmentation`."""

from __future__ import annotations

import base64
import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import colour_of
from scan2sim.pipeline.core.types import U8, Camera
from scan2sim.segmentation import backends
from scan2sim.segmentation.labels import CLASSES, code_of_index
from scan2sim.segmentation.photos import Classifier, class_map
from scan2sim.services.toolboxes import models
from scan2sim.services.toolboxes.models import ModelInfo
from scan2sim.services.toolboxes.results import Body, Segmentation
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.tasks import PostProcessor

log = logging.getLogger(__name__)

NEEDS = ("cv2", "onnxruntime")
OVERLAY_OPACITY = 0.55
"""Opacity of the class colours in drawn results."""
OWN_NETWORK = "street"
"""Network with included weights."""


class Params(ToolboxParams):
    """Settings of the semantic segmentation."""

    network: Annotated[
        str, Field(pattern=r"^[a-z]{1,20}$", description="Network: street (the project's own), segformer or onnx.")
    ] = OWN_NETWORK
    width: Annotated[
        int, Field(ge=32, le=8192, description="Maximum width in pixels; wider images are downscaled to it.")
    ] = 1920
    field_of_view: Annotated[
        float,
        Field(ge=5, le=175, description="Horizontal field of view of the images in degrees (network street only)."),
    ] = 80.0


def check(params: Params) -> None:
    """See `tasks.Toolbox`."""
    backends.check(params.network, _weights(params))


def load(params: Params) -> Segmenter:
    """Load the model (`tasks.Toolbox`)."""
    return Segmenter(params)


def post_processor(params: Params) -> PostProcessor | None:
    """None: images are segmented independently."""
    return None


def draw(image: U8, body: Body) -> U8:
    """Overlay the colours of the classes."""
    import cv2

    assert body.segmentation
    mask = cv2.resize(mask_of(body.segmentation), image.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    overlay: U8 = cv2.addWeighted(image, 1 - OVERLAY_OPACITY, colour_of()[code_of_index()[mask]], OVERLAY_OPACITY, 0)
    return overlay


def mask_of(segmentation: Segmentation) -> U8:
    """Class indices (H, W) of a result, `IGNORED` for none."""
    import cv2

    png = np.frombuffer(base64.b64decode(segmentation.mask), np.uint8)
    mask: U8 = cv2.imdecode(png, cv2.IMREAD_GRAYSCALE)
    return mask


def _weights(params: Params) -> Path | None:
    """The user's weights file; None: the included weights."""
    uses_included = params.network == OWN_NETWORK and params.weights is None
    return None if uses_included else models.weights_file(params, None)


class Segmenter:
    """Semantic segmentation model (`tasks.Model`)."""

    def __init__(self, params: Params) -> None:
        path = _weights(params)
        network = backends.load(params.network, path, params.device)
        self._classifier, self._params = Classifier(network, str(path or OWN_NETWORK)), params
        for warning in self._classifier.warnings():
            log.warning("%s", warning)
        self.info = ModelInfo(network.info.name, CLASSES, network.info.sha256, network.info.licence)

    def __call__(self, images: Sequence[U8]) -> list[Body]:
        """Segment each image, one image at a time."""
        return [Body(segmentation=self._segment(image)) for image in images]

    def _segment(self, image: U8) -> Segmentation:
        import cv2

        width = min(image.shape[1], self._params.width)
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        if width < image.shape[1]:
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        focal = width / 2 / math.tan(math.radians(self._params.field_of_view) / 2)
        camera = Camera("pinhole", width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        mask, _ = class_map(self._classifier.probabilities(image, camera), (height, width))
        count = np.bincount(mask.ravel(), minlength=256)[: len(CLASSES)] / mask.size
        _, png = cv2.imencode(".png", mask)
        return Segmentation(
            labels=CLASSES,
            shares={name: round(float(share), 4) for name, share in zip(CLASSES, count, strict=True) if share},
            mask=base64.b64encode(png.tobytes()).decode(),
            size=(width, height),
        )
