"""Toolbox `segment` with a network of the user: what was assumed is logged, pixels without a class have none."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from scan2sim.segmentation.labels import CLASSES, IGNORED
from scan2sim.services.toolboxes.tasks import segment
from tests.present import present
from tests.segmentation.backends.test_onnx import IMAGE, graph

onnx = pytest.importorskip("onnx", reason="makes the networks")


def test_pixels_without_a_label_have_no_class(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A network of label indices that takes bright pixels for a car (3), and others for nothing (255)."""
    make = onnx.helper.make_node
    nodes = [
        make("ReduceMean", ["image"], ["grey"], axes=[1], keepdims=0),
        make("Constant", [], ["zero"], value=onnx.numpy_helper.from_array(np.float32(0))),
        make("Constant", [], ["car"], value=onnx.numpy_helper.from_array(np.int64(3))),
        make("Constant", [], ["none"], value=onnx.numpy_helper.from_array(np.int64(IGNORED))),
        make("Greater", ["grey", "zero"], ["bright"]),
        make("Where", ["bright", "car", "none"], ["labels"]),
    ]
    path = graph(tmp_path / "net.onnx", nodes, IMAGE, {"labels": (7, [1, "h", "w"])})
    with caplog.at_level(logging.WARNING):
        model = segment.load(segment.Params(network="onnx", weights=path))
    assert "RGB with ImageNet's mean and standard deviation was assumed" in caplog.text
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, :32] = 255
    (body,) = model([image])
    found = present(body.segmentation)
    mask = segment.mask_of(found)
    assert (mask[:, :28] == CLASSES.index("vehicle")).all() and (mask[:, 36:] == IGNORED).all()
    assert list(found.shares) == ["vehicle"] and abs(found.shares["vehicle"] - 0.5) < 0.05
    drawn = segment.draw(image, body)
    assert drawn.shape == image.shape and drawn.dtype == np.uint8
