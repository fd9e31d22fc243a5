"""Detectors of other projects: each format is recognized by a small graph of its shape, and its boxes are right."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.services.toolboxes.tasks import detect
from scan2sim.services.toolboxes.tasks.detect import Params

onnx = pytest.importorskip("onnx")

IMAGE_SHAPE = (100, 200, 3)
BOX, LABEL, COCO_INDEX, COCO_ID, SCORE = (20.0, 30.0, 60.0, 80.0), "car", 2, 3, 0.875
"""Box in the image, and its class in COCO."""
SIZE = 640
LETTERBOXED = np.array(BOX) * 3.2 + [0, 160, 0, 160]
"""The box in an input of 640 x 640 with equal padding above and below."""
UPPER_LEFT = np.array(BOX) * 3.2
STRETCHED = np.array(BOX) * [3.2, 6.4, 3.2, 6.4]
Array = npt.NDArray[Any]
Inputs = Mapping[str, tuple[int, Sequence[int | str]]]


def centred(corners: Array) -> Array:
    """Centre, width and height of a box."""
    return np.concatenate([(corners[:2] + corners[2:]) / 2, corners[2:] - corners[:2]])


def write(
    path: Path,
    outputs: Mapping[str, Array],
    inputs: Inputs | None = None,
    metadata: Mapping[str, str] | None = None,
) -> Path:
    """Write a graph whose outputs are constant."""
    inputs = inputs or {"images": (onnx.TensorProto.FLOAT, (1, 3, SIZE, SIZE))}
    nodes, infos = [], []
    for name, value in outputs.items():
        nodes.append(onnx.helper.make_node("Constant", [], [name], value=onnx.numpy_helper.from_array(value)))
        kind = onnx.helper.np_dtype_to_tensor_dtype(value.dtype)
        infos.append(onnx.helper.make_tensor_value_info(name, kind, value.shape))
    given = [onnx.helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in inputs.items()]
    model = onnx.helper.make_model(
        onnx.helper.make_graph(nodes, "detector", given, infos), opset_imports=[onnx.helper.make_opsetid("", 17)]
    )
    model.ir_version = 8
    onnx.helper.set_model_props(model, dict(metadata or {}))
    onnx.save(model, path)
    return path


def yolov5(rows: int = 25200, classes: int = 80, label: int = COCO_INDEX, corners: Array = LETTERBOXED) -> Array:
    """Rows of centre, size, objectness and scores, twice with the same box."""
    out = np.zeros((1, rows, 5 + classes), np.float32)
    out[..., :2] = np.linspace(0, SIZE, rows)[None, :, None]
    for row, score in ((7, SCORE), (8, SCORE - 0.1)):
        out[0, row, :5] = [*centred(corners), 1.0]
        out[0, row, 5 + label] = score
    return out


def yolov6() -> Array:
    """As YOLOv5, with a row per cell and an objectness of 1."""
    out = yolov5(8400)
    out[..., 4] = 1
    return out


def yolov8(classes: int = 80, label: int = COCO_INDEX) -> Array:
    """Columns of centre, size and scores."""
    return np.ascontiguousarray(np.delete(yolov5(8400, classes, label), 4, axis=2).transpose(0, 2, 1))


def yolox_raw() -> Array:
    """Rows relative to their cells: the box is that of a cell of the stride 16."""
    centre, size = centred(UPPER_LEFT)[:2], centred(UPPER_LEFT)[2:]
    x, y = (centre // 16).astype(int)
    out = np.zeros((1, 8400, 85), np.float32)
    row = 80 * 80 + y * 40 + x
    out[0, row, :5] = [*(centre / 16 - [x, y]), *np.log(size / 16), 1.0]
    out[0, row, 5 + COCO_INDEX] = SCORE
    return out


def final(corners: Array, label: int, count: int = 300) -> tuple[Array, Array, Array]:
    """Boxes (1, count, 4), scores and labels (1, count)."""
    boxes, scores = np.zeros((1, count, 4), np.float32), np.zeros((1, count), np.float32)
    labels = np.zeros((1, count), np.int64)
    boxes[0, 0], scores[0, 0], labels[0, 0] = corners, SCORE, label
    return boxes, scores, labels


def built_in() -> Array:
    """Rows of corners, score and class."""
    boxes, scores, labels = final(LETTERBOXED, COCO_INDEX)
    return np.concatenate([boxes, scores[..., None], labels[..., None].astype(np.float32)], axis=2)


def logits(classes: int, label: int, corners: Array, softmax: bool, count: int = 100) -> tuple[Array, Array]:
    """Class logits, and boxes relative to the input."""
    values = np.full((1, count, classes), -9.0, np.float32)
    if softmax:  # the probability of two classes sums to 1
        values[0, :, -1], values[0, 0, -1] = 9.0, 0.0
        values[0, 0, label] = np.log(SCORE / (1 - SCORE))
        values[0, 0, :-1][np.arange(classes - 1) != label] = -30.0
    else:
        values[0, 0, label] = np.log(SCORE / (1 - SCORE))
    boxes = np.full((1, count, 4), 0.5, np.float32)
    boxes[0, 0] = centred(corners) / SIZE
    return values, boxes


def relative_rows() -> Array:
    """Rows of boxes relative to the input, and scores."""
    out = np.zeros((1, 300, 84), np.float32)
    out[0, 4, :4], out[0, 4, 4 + COCO_INDEX] = centred(STRETCHED) / SIZE, SCORE
    return out


def named(*arrays: Array, names: str) -> dict[str, Array]:
    """Outputs by name, names separated by blanks."""
    return dict(zip(names.split(), arrays, strict=True))


FLOAT, INT64 = onnx.TensorProto.FLOAT, onnx.TensorProto.INT64
IMAGES: Inputs = {"images": (FLOAT, (1, 3, SIZE, SIZE))}
DETR_INPUTS: Inputs = {"pixel_values": (FLOAT, (1, 3, SIZE, SIZE)), "pixel_mask": (INT64, (1, SIZE, SIZE))}
TORCHVISION = tuple(one[0] for one in final(STRETCHED, COCO_ID, 5))
FORMATS: dict[str, tuple[str, Callable[[], Mapping[str, Array]], Inputs, Mapping[str, str]]] = {
    "yolov5": ("YOLOv5", lambda: {"output0": yolov5()}, IMAGES, {"stride": "32"}),
    "yolov5, one class": (
        "YOLOv5", lambda: {"output0": yolov5(classes=1, label=0)}, IMAGES, {"stride": "32", "names": "{0: 'car'}"}
    ),
    "yolov6": ("YOLOv5", lambda: {"outputs": yolov6()}, IMAGES, {}),
    "yolov7": ("YOLOv5", lambda: {"output": yolov5()}, IMAGES, {}),
    "yolov7, end2end": (
        "built-in",
        lambda: {"output": np.array([[0, *LETTERBOXED, COCO_INDEX, SCORE]], np.float32)},
        IMAGES, {},
    ),
    "yolov7, TensorRT": (
        "built-in",
        lambda: named(np.array([[1]], np.int32), *final(LETTERBOXED, COCO_INDEX),
                      names="num_dets det_boxes det_scores det_classes"),
        IMAGES, {},
    ),
    "yolov8": ("YOLOv8", lambda: {"output0": yolov8()}, IMAGES, {}),
    "yolov11, own classes": (
        "YOLOv8", lambda: {"output0": yolov8(2, 1)}, IMAGES, {"names": "{0: 'person', 1: 'car'}", "stride": "32"}
    ),
    "yolov10": ("built-in", lambda: {"output0": built_in()}, IMAGES, {}),
    "yolox": ("YOLOX", lambda: {"output": yolox_raw()}, IMAGES, {}),
    "yolox, decoded": ("YOLOX", lambda: {"output": yolov5(8400, corners=UPPER_LEFT)}, IMAGES, {}),
    "rt-detr": (
        "RT-DETR",
        lambda: named(*reversed(final(STRETCHED, COCO_INDEX)[::2]), final(STRETCHED, COCO_INDEX)[1],
                      names="labels boxes scores"),
        {**IMAGES, "orig_target_sizes": (INT64, (1, 2))}, {},
    ),
    "d-fine of transformers": (
        "RT-DETR",
        lambda: named(*logits(80, COCO_INDEX, STRETCHED, softmax=False, count=300), names="logits pred_boxes"),
        {"pixel_values": (FLOAT, (1, 3, SIZE, SIZE))}, {},
    ),
    "rt-detr of Ultralytics": ("Ultralytics", lambda: {"output0": relative_rows()}, IMAGES, {}),
    "detr": (
        "DETR", lambda: named(*logits(92, COCO_ID, STRETCHED, softmax=True), names="logits pred_boxes"), DETR_INPUTS, {}
    ),
    "torchvision": (
        "torchvision", lambda: named(TORCHVISION[0], TORCHVISION[2], TORCHVISION[1], names="boxes labels scores"),
        {"images": (FLOAT, (3, SIZE, SIZE))}, {},
    ),
    "torchvision, unnamed": (
        "torchvision", lambda: named(*TORCHVISION, names="3076 3077 3078"), IMAGES, {}
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", FORMATS)
def test_exported_detector_is_recognized_and_its_boxes_are_right(tmp_path: Path, case: str) -> None:
    name, outputs, inputs, metadata = FORMATS[case]
    model = detect.Detector(Params(weights=write(tmp_path / "mine.onnx", outputs(), inputs, metadata)))
    assert name in model.format
    (body,) = model([np.zeros(IMAGE_SHAPE, np.uint8)])
    assert body.detections is not None and len(body.detections) == 1, "duplicates are suppressed"
    (found,) = body.detections
    assert found.label == LABEL
    assert found.score == pytest.approx(SCORE, abs=1e-3)
    assert found.box == pytest.approx(BOX, abs=0.11)
    assert body.threshold == detect.DEFAULT_THRESHOLD


def test_detr_with_dynamic_size_keeps_proportions(tmp_path: Path) -> None:
    relative = np.array(BOX) / [200, 100, 200, 100] * SIZE
    dynamic: Inputs = {"pixel_values": (FLOAT, (1, 3, "height", "width"))}
    values, boxes = logits(92, COCO_ID, relative, softmax=True)
    model = detect.Detector(
        Params(weights=write(tmp_path / "detr.onnx", {"logits": values, "pred_boxes": boxes}, dynamic))
    )
    (body,) = model([np.zeros(IMAGE_SHAPE, np.uint8)])
    assert body.detections is not None and body.detections[0].box == pytest.approx(BOX, abs=0.11)


def test_yolox_gets_blue_first_and_values_up_to_255(tmp_path: Path) -> None:
    """The score is the mean of the input's first channel: only a blue image gives 1."""
    rows = yolox_raw()
    rows[..., 5 + COCO_INDEX] /= SCORE
    given = onnx.helper.make_tensor_value_info("images", FLOAT, (1, 3, SIZE, SIZE))
    made = onnx.helper.make_tensor_value_info("output", FLOAT, rows.shape)
    factor = np.ones((1, 1, 85), np.float32)
    factor[..., 5:] = 1 / 255
    constants = {
        "rows": rows, "factor": factor, "first": np.array([0], np.int64), "one": np.ones((1, 1, 85), np.float32),
        "is_score": (np.arange(85) >= 5).reshape(1, 1, 85),
    }  # fmt: skip
    nodes = [
        onnx.helper.make_node("Gather", ["images", "first"], ["blue"], axis=1),
        onnx.helper.make_node("ReduceMax", ["blue"], ["most"], keepdims=0),
        onnx.helper.make_node("Mul", ["factor", "most"], ["scaled"]),
        onnx.helper.make_node("Where", ["is_score", "scaled", "one"], ["used"]),
        onnx.helper.make_node("Mul", ["rows", "used"], ["output"]),
    ]
    kept = [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()]
    model = onnx.helper.make_model(
        onnx.helper.make_graph(nodes, "yolox", [given], [made], kept), opset_imports=[onnx.helper.make_opsetid("", 17)]
    )
    model.ir_version = 8
    onnx.save(model, tmp_path / "yolox.onnx")
    detector = detect.Detector(Params(weights=tmp_path / "yolox.onnx"))
    blue, red = np.zeros((SIZE, SIZE, 3), np.uint8), np.zeros((SIZE, SIZE, 3), np.uint8)
    blue[..., 2], red[..., 0] = 255, 255
    of_blue, of_red = detector([blue, red])
    assert of_blue.detections and of_blue.detections[0].score == pytest.approx(1)
    assert not of_red.detections


@pytest.mark.parametrize(
    ("outputs", "metadata"),
    [
        ({"heat": np.zeros((1, 80, 160, 160), np.float32)}, {}),
        ({"output0": np.zeros((1, 116, 8400), np.float32), "output1": np.zeros((1, 32, 160, 160), np.float32)}, {}),
        ({"output0": np.zeros((1, 84, 8400), np.float32)}, {"names": "['car', 'bus']"}),
    ],
)
def test_unknown_outputs_are_described_with_the_supported_formats(
    tmp_path: Path, outputs: dict[str, Array], metadata: dict[str, str]
) -> None:
    path = write(tmp_path / "mine.onnx", outputs, IMAGES, metadata)
    with pytest.raises(InputError) as caught:
        detect.load(Params(weights=path))
    message = str(caught.value)
    assert str(next(iter(outputs.values())).shape) in message and "mine.onnx" in message
    assert all(name in message for name in ("YOLOv5", "YOLOX", "D-FINE", "DETR", "torchvision"))


def test_unknown_class_number_names_the_file_for_labels(tmp_path: Path) -> None:
    boxes, scores, labels = final(STRETCHED, 85)
    path = write(tmp_path / "mine.onnx", {"labels": labels, "boxes": boxes, "scores": scores})
    with pytest.raises(InputError, match=r"class 85.*80[\s\S]*mine\.labels\.txt"):
        detect.load(Params(weights=path))([np.zeros(IMAGE_SHAPE, np.uint8)])


def test_class_names_of_a_text_file_are_used(tmp_path: Path) -> None:
    path = write(tmp_path / "mine.onnx", {"output0": yolov8(2, 1)})
    (tmp_path / "mine.labels.txt").write_text("tram\nbarrier\n", encoding="utf-8")
    (body,) = detect.load(Params(weights=path))([np.zeros(IMAGE_SHAPE, np.uint8)])
    assert [one.label for one in body.detections or ()] == ["barrier"]


def test_class_names_of_hugging_faces_config_are_used(tmp_path: Path) -> None:
    path = write(tmp_path / "mine.onnx", {"output0": yolov8(2, 1)})
    (tmp_path / "config.json").write_text('{"id2label": {"0": "tram", "1": "barrier"}}', encoding="utf-8")
    (body,) = detect.load(Params(weights=path))([np.zeros(IMAGE_SHAPE, np.uint8)])
    assert [one.label for one in body.detections or ()] == ["barrier"]


def test_error_on_missing_class_names_names_their_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"labels\.txt"):
        detect.load(Params(weights=write(tmp_path / "mine.onnx", {"output0": yolov8(2, 1)})))
