"""Object detection (D3.2, section 5.1): the user's ONNX file (`detector_formats`), or the project's own detector."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.segmentation import onnx_session
from scan2sim.services.toolboxes import coco, detector_formats, drawing, models, yolo
from scan2sim.services.toolboxes.detector_formats import Outputs
from scan2sim.services.toolboxes.models import ModelInfo
from scan2sim.services.toolboxes.results import Body, Detection
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.tasks import Model, PostProcessor

NEEDS = ("cv2", "onnxruntime")
INCLUDED_WEIGHTS = models.FOLDER / "vehicles.onnx"
DEFAULT_THRESHOLD = 0.25
"""Minimum score of networks whose metadata has no `thresholds`."""
OWN_NETWORK, OWN_SIZE_PX = "VehicleNet", 960
"""Architecture of the project's own network, and the longer side of its input; smaller images are not enlarged."""
PROBE_SIZE_PX = 640
"""Side of the grey image by which the format of a network with dynamic input size is recognized."""
NUMPY_TYPES = {**onnx_session.FLOATS, "tensor(int64)": "int64", "tensor(int32)": "int32", "tensor(bool)": "bool"}
REMEDY = detector_formats.REMEDY


class Params(ToolboxParams):
    """Settings of the detection."""

    network: Annotated[
        Literal["onnx", "yolov5", "coco"],
        Field(
            description="onnx: --weights or the project's own network; coco: SSD network of a package to install"
            " (docs/toolboxes.md); yolov5: the former name of onnx."
        ),
    ] = "onnx"
    size: Annotated[
        int | None,
        Field(
            ge=64,
            le=4096,
            description="Longer side of the input in pixels for models with dynamic input size. Default:"
            f" {OWN_SIZE_PX} of the project's own network (smaller images are not enlarged), 640 of YOLOs and RT-DETR,"
            " 1066 of DETR, 1333 of torchvision's.",
        ),
    ] = None
    threshold: Annotated[
        float | None,
        Field(
            ge=0.01,
            le=1,
            description="Minimum score of a detection, for all classes. Default: by class as in the file's metadata"
            f" `thresholds`, such as those of the project's own network; {DEFAULT_THRESHOLD:g} of others.",
        ),
    ] = None
    overlap: Annotated[
        float,
        Field(ge=0.05, le=1, description="Non-maximum suppression: IoU above which two boxes are the same object."),
    ] = 0.45
    labels: Annotated[
        str, Field(max_length=10_000, description="Labels to detect, such as car,bus,train; default: all.")
    ] = ""


def check(params: Params) -> None:
    """See `tasks.Toolbox`."""
    if params.network == "coco":
        coco.files()
    else:
        models.weights_file(params, INCLUDED_WEIGHTS)


def load(params: Params) -> Model:
    """Load the model (`tasks.Toolbox`)."""
    if params.network == "coco":
        least = DEFAULT_THRESHOLD if params.threshold is None else params.threshold
        return coco.Detector(least, params.overlap, _selected_labels(params, coco.LABELS.values()))
    return Detector(params)


def post_processor(params: Params) -> PostProcessor | None:
    """None: images are processed independently."""
    return None


def draw(image: U8, body: Body) -> U8:
    """Draw the boxes of the objects."""
    return drawing.detections(image, body.detections or ())


class Detector:
    """Detector (`tasks.Model`)."""

    def __init__(self, params: Params) -> None:
        """Load the network and recognize its format.

        Raises:
            InputError: the file is invalid, or its format is unknown.
            SettingError: the network doesn't know a label that is to be detected.
        """
        self._path = path = models.weights_file(params, INCLUDED_WEIGHTS)
        self._params, self._session = params, onnx_session.open_session(path, params.device, "--device")
        inputs = self._session.get_inputs()
        images = [one for one in inputs if _is_image(one)]
        if len(images) != 1 or any(one.type not in NUMPY_TYPES for one in inputs):
            described = ", ".join(f"{one.name} {one.type} {one.shape}" for one in inputs)
            remedy = f"Export it with one input of images (N, 3, H, W), floats. {REMEDY}"
            raise InputError(path, f"has the inputs {described}", remedy)
        self._image = images[0]
        self._types = {one.name: NUMPY_TYPES[one.type] for one in inputs}
        shape = self._image.shape
        self._fixed = tuple(shape[-2:]) if all(isinstance(n, int) for n in shape[-2:]) else None
        metadata = self._session.get_modelmeta().custom_metadata_map
        self._stride = 1 if self._fixed else int(float(metadata.get("stride", 64)))
        probed = self._fixed or (PROBE_SIZE_PX, PROBE_SIZE_PX)
        grey = self._run(np.full((1, 3, *probed), 0.5, np.float32))
        self._format = detector_formats.recognize(path, list(self._types), grey, probed, metadata)
        self._batches = self._format.batches and len(shape) == 4 and not isinstance(shape[0], int)
        self._is_own = metadata.get("network") == OWN_NETWORK
        labels = self._format.names
        self._thresholds = thresholds(params, labels, metadata)
        self._selected = _selected_labels(params, labels) or frozenset(labels)
        licence = metadata.get("licence") or metadata.get("license") or "not stated"
        self.info = ModelInfo(path.stem, labels, onnx_session.digest(path), licence)

    @property
    def format(self) -> str:
        """Name of the recognized format."""
        return self._format.name

    def __call__(self, images: Sequence[U8]) -> list[Body]:
        """Detect objects in each image; images with the same input shape are processed as a batch."""
        prepared = [self.prepared(image) for image in images]
        found: dict[int, Body] = {}
        for shape in {tensor.shape for tensor, _ in prepared}:
            of_shape = [i for i, (tensor, _) in enumerate(prepared) if tensor.shape == shape]
            for group in [of_shape] if self._batches else [[i] for i in of_shape]:
                outputs = self._run(np.stack([prepared[i][0] for i in group]))
                for k, i in enumerate(group):
                    found[i] = self._body(outputs, k, (shape[1], shape[2]), prepared[i][1])
        return [found[i] for i in range(len(images))]

    def prepared(self, image: U8) -> tuple[F32, yolo.Transform]:
        """Input (3, h, w) of an image, and its transform."""
        form, longer = self._format, max(image.shape[:2])
        size = self._params.size or (min(OWN_SIZE_PX, longer) if self._is_own else form.size)
        if form.fit == "letterbox":
            tensor, transform = yolo.letterbox(image, self._fixed or size, self._stride, centred=form.centred)
        else:
            square = (size, size)
            scaled = tuple(max(1, round(side * size / longer)) for side in image.shape[:2])
            shape = self._fixed or (square if form.fit == "stretch" else (scaled[0], scaled[1]))
            tensor, transform = yolo.stretch(image, shape)
        return form.normalised(tensor), transform

    def _run(self, tensor: F32) -> Outputs:
        """Outputs for a batch (B, 3, h, w)."""
        feed: dict[str, Any] = {self._image.name: tensor if len(self._image.shape) == 4 else tensor[0]}
        height, width = tensor.shape[2:]
        for name in self._types:
            if name == "orig_target_sizes":
                feed[name] = np.tile([width, height], (len(tensor), 1))
            elif name == "pixel_mask":
                feed[name] = np.ones((len(tensor), height, width))
        if unknown := self._types.keys() - feed.keys():
            raise InputError(self._path, f"has inputs that aren't known: {', '.join(sorted(unknown))}", REMEDY)
        names = [one.name for one in self._session.get_outputs()]
        try:
            outputs = self._session.run(names, {name: one.astype(self._types[name]) for name, one in feed.items()})
        except Exception as error:  # onnxruntime's errors have no common base class
            raise onnx_session.session_error(error, self._path, f"fails on {tensor.shape}", REMEDY) from None
        return dict(zip(names, outputs, strict=True))

    def _body(self, outputs: Outputs, index: int, size: tuple[int, int], transform: yolo.Transform) -> Body:
        form = self._format
        found = form.decode(outputs, index, size)
        if len(found.labels) and not 0 <= found.labels.min() <= found.labels.max() < len(form.names):
            cause = f"reports class {found.labels.max()}, but has names of {len(form.names)}"
            raise InputError(self._path, cause, f"Name its classes in {self._path.stem}.labels.txt, one per line")
        iou = self._params.overlap if form.overlapping else None
        boxes = yolo.select(found.corners, found.scores, found.labels, transform, self._thresholds, iou)
        return Body(
            detections=tuple(
                Detection(
                    label=form.names[label],
                    score=round(float(score), 4),
                    box=tuple(corners.astype(np.float64).round(1).tolist()),
                )
                for corners, score, label in zip(boxes.corners, boxes.scores, boxes.labels, strict=True)
                if form.names[label] in self._selected
            ),
            threshold=stated(self._thresholds, form.names),
        )


def _is_image(one: Any) -> bool:
    """Whether an input of a network takes images."""
    is_image = len(one.shape) in (3, 4) and (one.shape[-3] == 3 or not isinstance(one.shape[-3], int))
    return bool(is_image and one.type in onnx_session.FLOATS)


def thresholds(params: Params, labels: Sequence[str], metadata: Mapping[str, str]) -> F32:
    """Minimum score of each class."""
    own = onnx_session.metadata_value(metadata.get("thresholds"), {})
    by_class = own if params.threshold is None and isinstance(own, dict) else {}
    least = DEFAULT_THRESHOLD if params.threshold is None else params.threshold
    return np.array([float(by_class.get(label, least)) for label in labels], np.float32)


def stated(least: F32, labels: Sequence[str]) -> float | dict[str, float]:
    """Minimum scores as they are stated in a result: a number if they are the same for all classes."""
    values = [round(float(value), 4) for value in least]
    return values[0] if len(set(values)) == 1 else dict(zip(labels, values, strict=True))


def _selected_labels(params: Params, known: Iterable[str]) -> frozenset[str]:
    """Labels to detect; empty: all.

    Raises:
        SettingError: the model doesn't know one of the labels.
    """
    selected = frozenset(name.strip() for name in params.labels.split(",") if name.strip())
    if unknown := selected - set(known):
        cause = f"the model doesn't know {', '.join(sorted(unknown))}"
        raise SettingError("--labels", cause, f"Known: {', '.join(known)}")
    return selected
