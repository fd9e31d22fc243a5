"""Object detection (D3.2, section 5.1): a YOLOv5 network from the user's ONNX file, or the project's own detector."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.segmentation import onnx_session
from scan2sim.services.toolboxes import coco, drawing, models, yolo
from scan2sim.services.toolboxes.models import ModelInfo
from scan2sim.services.toolboxes.results import Body, Detection
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.tasks import Model, PostProcessor

NEEDS = ("cv2", "onnxruntime")
INCLUDED_WEIGHTS = models.FOLDER / "vehicles.onnx"
REMEDY = "Export it with YOLOv5's export.py: input images (N, 3, H, W), output (N, boxes, 5 + classes)"


class Params(ToolboxParams):
    """Settings of the detection."""

    network: Annotated[
        Literal["yolov5", "coco"],
        Field(
            description="yolov5: --weights or the project's own network; coco: SSD network of a package to install"
            " (docs/toolboxes.md)."
        ),
    ] = "yolov5"
    size: Annotated[
        int,
        Field(ge=64, le=4096, description="Longer side of the input in pixels for models with dynamic input size."),
    ] = 640
    threshold: Annotated[float, Field(ge=0.01, le=1, description="Minimum score of a detection.")] = 0.25
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
        return coco.Detector(params.threshold, params.overlap, _selected_labels(params, coco.LABELS.values()))
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
        self._path = path = models.weights_file(params, INCLUDED_WEIGHTS)
        self._params, self._session = params, onnx_session.open_session(path, params.device, "--device")
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shape = inputs[0].shape
        if (
            len(inputs) != 1
            or len(shape) != 4
            or shape[1] not in (3, None)
            or inputs[0].type not in onnx_session.FLOATS
        ):
            raise InputError(path, f"has inputs {[(one.type, one.shape) for one in inputs]}", REMEDY)
        if len(outputs[0].shape) != 3:
            raise InputError(path, f"has an output of shape {outputs[0].shape}", REMEDY)
        self._input, self._type, self._output = inputs[0].name, onnx_session.FLOATS[inputs[0].type], outputs[0].name
        self._has_fixed_batch = isinstance(shape[0], int)
        self._size = tuple(shape[2:]) if all(isinstance(n, int) for n in shape[2:]) else params.size
        metadata = self._session.get_modelmeta().custom_metadata_map
        self._stride = int(float(metadata.get("stride", 64)))
        labels = _class_names(path, metadata)
        self._selected = _selected_labels(params, labels) or frozenset(labels)
        licence = metadata.get("licence") or metadata.get("license") or "not stated"
        self.info = ModelInfo(path.stem, labels, onnx_session.digest(path), licence)

    def __call__(self, images: Sequence[U8]) -> list[Body]:
        """Detect objects in each image; images with the same input shape are processed as a batch."""
        letterboxed = [yolo.letterbox(image, self._size, self._stride) for image in images]
        found: dict[int, Body] = {}
        for shape in {tensor.shape for tensor, _ in letterboxed}:
            of_shape = [i for i, (tensor, _) in enumerate(letterboxed) if tensor.shape == shape]
            for group in [[i] for i in of_shape] if self._has_fixed_batch else [of_shape]:
                outputs = self._run(np.stack([letterboxed[i][0] for i in group]))
                for i, output in zip(group, outputs, strict=True):
                    found[i] = self._body(output, letterboxed[i][1])
        return [found[i] for i in range(len(images))]

    def _run(self, tensor: F32) -> F32:
        try:
            (output,) = self._session.run([self._output], {self._input: tensor.astype(self._type)})
        except Exception as error:  # onnxruntime's errors have no common base class
            raise onnx_session.session_error(error, self._path, f"fails on {tensor.shape}", REMEDY) from None
        if output.ndim != 3 or output.shape[2] != 5 + len(self.info.labels):
            cause = f"outputs shape {output.shape} for {len(self.info.labels)} classes"
            raise InputError(self._path, cause, REMEDY)
        return np.asarray(output, np.float32)

    def _body(self, output: F32, transform: yolo.Transform) -> Body:
        boxes = yolo.decode(output, transform, self._params.threshold, self._params.overlap)
        labels = self.info.labels
        return Body(
            detections=tuple(
                Detection(
                    label=labels[label],
                    score=round(float(score), 4),
                    box=tuple(corners.astype(np.float64).round(1).tolist()),
                )
                for corners, score, label in zip(boxes.corners, boxes.scores, boxes.labels, strict=True)
                if labels[label] in self._selected
            )
        )


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


def _class_names(path: Path, metadata: dict[str, str]) -> tuple[str, ...]:
    """Names of the classes: YOLOv5 writes a dictionary as a Python literal into the metadata `names`."""
    try:
        names: Any = ast.literal_eval(metadata["names"])
        if isinstance(names, dict):
            names = [names[i] for i in range(len(names))]
        return tuple(map(str, names))
    except (KeyError, ValueError, SyntaxError, TypeError):
        return onnx_session.read_labels(path, metadata)
