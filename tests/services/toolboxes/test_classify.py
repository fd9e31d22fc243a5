"""Classification: the default network gives the same results in PyTorch and as the ONNX file of the containers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("efficientnet_lite_pytorch", reason="the extra toolboxes isn't installed")

from scan2sim.services.toolboxes.detector import imagenet
from scan2sim.services.toolboxes.tasks import classify
from tests.conftest import ROOT


def test_exported_onnx_matches_torch(tmp_path: Path) -> None:
    import cv2

    path = tmp_path / "efficientnet-lite0.onnx"
    imagenet.export(path)
    by_torch = classify.load(classify.Params(device="cpu"))
    by_file = classify.load(classify.Params(weights=path, device="cpu"))
    assert by_file.info.labels == by_torch.info.labels and len(by_file.info.labels) == 1000
    assert (by_file.info.name, by_file.info.licence) == (by_torch.info.name, "Apache-2.0")
    photos = sorted((ROOT / "data_samples" / "tile").rglob("*.jpg"))[:3]
    images = [cv2.imread(str(photo))[..., ::-1].copy() for photo in photos]
    images.append(np.random.default_rng(0).integers(0, 256, (300, 200, 3), np.uint8))
    for onnx, torch in zip(by_file(images), by_torch(images), strict=True):
        assert onnx.classes and torch.classes
        assert [one.label for one in onnx.classes] == [one.label for one in torch.classes]
        np.testing.assert_allclose([one.score for one in onnx.classes], [one.score for one in torch.classes], atol=2e-4)
