"""Detection of objects (D3.2, section 5.1): YOLOv5's topologies from the user's ONNX file, or the project's own."""

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
from scan2sim.services.toolboxes.results import Body, Detection
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.tasks import Facts, Follow, Model

NEEDS = ("cv2", "onnxruntime")
OWN = models.FOLDER / "vehicles.onnx"
REMEDY = "Export it as YOLOv5's export.py does: images (N, 3, H, W) in, (N, boxes, 5 + classes) out"


class Params(ToolboxParams):
    """Of detection."""

    network: Annotated[
        Literal["yolov5", "coco"],
        Field(description="yolov5: what its form is of; coco: SSD of a package that you install (docs/toolboxes.md)."),
    ] = "yolov5"
    size: Annotated[
        int, Field(ge=64, le=4096, description="Pixels of the longer side that a model of any size looks at.")
    ] = 640
    threshold: Annotated[float, Field(ge=0.01, le=1, description="Score from which a detection counts.")] = 0.25
    overlap: Annotated[
        float, Field(ge=0.05, le=1, description="Intersection over union from which two boxes are of one thing.")
    ] = 0.45
    labels: Annotated[
        str, Field(max_length=10_000, description="Labels that count, as car,bus,train; all without.")
    ] = ""


def check(params: Params) -> None:
    """See `boxes.Toolbox`."""
    if params.network == "coco":
        coco.files()
    else:
        models.chosen(params, OWN)


def load(params: Params) -> Model:
    """The model (`boxes.Toolbox`)."""
    if params.network == "coco":
        return coco.Detector(params.threshold, params.overlap, _wanted(params, coco.LABELS.values()))
    return Detector(params)


def follow(params: Params) -> Follow | None:
    """Images are looked at one by one."""
    return None


def draw(image: U8, body: Body) -> U8:
    """With the things' boxes."""
    return drawing.detections(image, body.detections or ())


class Detector:
    """See `boxes.Model`."""

    def __init__(self, params: Params) -> None:
        self._path = path = models.chosen(params, OWN)
        self._params, self._session = params, onnx_session.opened(path, params.device, "--device")
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shape = inputs[0].shape
        if (
            len(inputs) != 1
            or len(shape) != 4
            or shape[1] not in (3, None)
            or inputs[0].type not in onnx_session.FLOATS
        ):
            raise InputError(path, f"takes {[(one.type, one.shape) for one in inputs]}", REMEDY)
        if len(outputs[0].shape) != 3:
            raise InputError(path, f"gives {outputs[0].shape}", REMEDY)
        self._input, self._type, self._output = inputs[0].name, onnx_session.FLOATS[inputs[0].type], outputs[0].name
        self._alone = isinstance(shape[0], int)
        self._size = tuple(shape[2:]) if all(isinstance(n, int) for n in shape[2:]) else params.size
        metadata = self._session.get_modelmeta().custom_metadata_map
        self._stride = int(float(metadata.get("stride", 64)))
        labels = _names(path, metadata)
        self._wanted = _wanted(params, labels) or frozenset(labels)
        licence = metadata.get("licence") or metadata.get("license") or "not told"
        self.facts = Facts(path.stem, labels, onnx_session.digest(path), licence)

    def __call__(self, images: Sequence[U8]) -> list[Body]:
        """Objects in each image; those that become of one shape are looked at together."""
        boxed = [yolo.letterbox(image, self._size, self._stride) for image in images]
        found: dict[int, Body] = {}
        for shape in {tensor.shape for tensor, _ in boxed}:
            of_shape = [i for i, (tensor, _) in enumerate(boxed) if tensor.shape == shape]
            for group in [[i] for i in of_shape] if self._alone else [of_shape]:
                outputs = self._run(np.stack([boxed[i][0] for i in group]))
                for i, output in zip(group, outputs, strict=True):
                    found[i] = self._body(output, boxed[i][1])
        return [found[i] for i in range(len(images))]

    def _run(self, tensor: F32) -> F32:
        try:
            (output,) = self._session.run([self._output], {self._input: tensor.astype(self._type)})
        except Exception as error:  # onnxruntime's errors have no kind in common
            raise onnx_session.failure(error, self._path, f"fails on {tensor.shape}", REMEDY) from None
        if output.ndim != 3 or output.shape[2] != 5 + len(self.facts.labels):
            raise InputError(self._path, f"gives {output.shape} for {len(self.facts.labels)} classes", REMEDY)
        return np.asarray(output, np.float32)

    def _body(self, output: F32, transform: yolo.Transform) -> Body:
        boxes = yolo.decode(output, transform, self._params.threshold, self._params.overlap)
        labels = self.facts.labels
        return Body(
            detections=tuple(
                Detection(
                    label=labels[label],
                    score=round(float(score), 4),
                    box=tuple(corners.astype(np.float64).round(1).tolist()),
                )
                for corners, score, label in zip(boxes.corners, boxes.scores, boxes.labels, strict=True)
                if labels[label] in self._wanted
            )
        )


def _wanted(params: Params, known: Iterable[str]) -> frozenset[str]:
    """Labels that count; none: all do.

    Raises:
        SettingError: one isn't known.
    """
    wanted = frozenset(name.strip() for name in params.labels.split(",") if name.strip())
    if unknown := wanted - set(known):
        raise SettingError("--labels", f"{', '.join(sorted(unknown))}: not known", f"Known: {', '.join(known)}")
    return wanted


def _names(path: Path, metadata: dict[str, str]) -> tuple[str, ...]:
    """Of the classes: YOLOv5 writes a dictionary, as Python prints it, into `names`."""
    try:
        named: Any = ast.literal_eval(metadata["names"])
        if isinstance(named, dict):
            named = [named[i] for i in range(len(named))]
        return tuple(map(str, named))
    except (KeyError, ValueError, SyntaxError, TypeError):
        return onnx_session.labels(path, metadata)
