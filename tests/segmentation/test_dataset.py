"""Labelled photos of users: indices of palettes and grey levels, names of other label sets, and what is no label."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.segmentation.label_images import read_classes
from scan2sim.segmentation.labels import CLASSES, IGNORED
from scan2sim.segmentation.training.dataset import names_of, pairs, read

CITYSCAPES = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation", "terrain",
    "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle",
)  # fmt: skip


def write(folder: Path, values: list[int], mode: str = "L") -> Path:
    """Write a photo with a label image of one row of these values."""
    for name in ("images", "labels"):
        (folder / name).mkdir(exist_ok=True)
    label = Image.fromarray(np.array([values], np.uint8), "L")
    if mode == "P":
        palette = np.random.default_rng(0).integers(0, 256, 768, np.uint8)
        label = Image.frombytes("P", label.size, label.tobytes())
        label.putpalette(palette.tobytes())
    elif mode != "L":
        label = label.convert(mode)
    label.save(folder / "labels" / "a.png")
    Image.fromarray(np.zeros((1, len(values), 3), np.uint8)).save(folder / "images" / "a.png")
    return folder / "labels" / "a.png"


def names(found: np.ndarray) -> list[str | None]:
    return [None if index == IGNORED else CLASSES[index] for index in found.ravel()]


@pytest.mark.parametrize("mode", ["L", "P"])
def test_las_codes_are_read_with_and_without_a_palette(tmp_path: Path, mode: str) -> None:
    write(tmp_path, [11, 0, 6, 255, 1, 5], mode)
    ((image, truth),) = pairs(tmp_path)
    rgb, found = read(image, truth)
    assert rgb.shape == (1, 6, 3)
    assert names(found) == ["road", "sky", "building", None, None, "high_vegetation"]


@pytest.mark.parametrize("mode", ["L", "P"])
def test_labels_of_other_sets_are_read_by_their_names(tmp_path: Path, mode: str) -> None:
    truth = write(tmp_path, [0, 1, 2, 8, 10, 13, 255], mode)  # train ids of Cityscapes
    (tmp_path / "labels.txt").write_text("\n".join(CITYSCAPES) + "\n", encoding="utf-8")
    expected = ["road", "sidewalk", "building", "high_vegetation", "sky", "vehicle", None]
    assert names(read_classes(truth, names_of(truth))) == expected
    write(tmp_path, [0, 1, 2, 19], mode)
    with pytest.raises(DataError, match="no classes of photos: 19.*labels.txt"):
        read_classes(truth, names_of(truth))
    (tmp_path / "labels.txt").write_text("void\nwall\n\nbuilding", encoding="utf-8")
    with pytest.raises(InputError, match="line 3 is empty"):
        read_classes(truth, names_of(truth))


def test_ids_of_other_sets_without_names_are_rejected(tmp_path: Path) -> None:
    truth = write(tmp_path, [0, 1, 2, 8, 10, 13, 255])
    with pytest.raises(DataError, match=r"no classes of photos: 8, 10, 13\. .*labels\.txt"):
        read_classes(truth, names_of(truth))


@pytest.mark.parametrize("mode", ["RGB", "I;16", "1", "LA"])
def test_images_of_colours_or_instances_are_rejected(tmp_path: Path, mode: str) -> None:
    with pytest.raises(DataError, match="not indices of classes"):
        read_classes(write(tmp_path, [11, 0, 6], mode), tmp_path / "none")


def test_damaged_label_file_is_rejected(tmp_path: Path) -> None:
    truth = write(tmp_path, [11, 0, 6])
    truth.write_bytes(truth.read_bytes()[:40])
    with pytest.raises(DataError, match="can't be read"):
        read_classes(truth, names_of(truth))
