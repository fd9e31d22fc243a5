"""Classification of photos of any size and camera, with a fake network that predicts a pixel's class by its colour."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8, Camera
from scan2sim.segmentation.backends import NetworkInfo
from scan2sim.segmentation.labels import CLASSES, IGNORED, LABEL_SETS, code_of_index, index_of_code, map_labels
from scan2sim.segmentation.photos import TILE_OVERLAP_PX, Classifier, class_map

PINHOLE = Camera("pinhole", 640, 480, 500.0, 500.0, 319.5, 239.5)
PANORAMA = Camera("equirectangular", 1024, 512)


class ByColour:
    """Predicts class k where red is 20 k; records the sizes in `seen`, and has memory for `memory` pixels."""

    def __init__(self, labels: Sequence[str] = CLASSES, resolution: float = 500.0, memory: int = 10**9) -> None:
        self.info = NetworkInfo("by colour", tuple(labels), "", "", resolution)
        self.memory = memory
        self.seen: list[tuple[int, ...]] = []

    def probabilities(self, rgb: U8) -> F32:
        if rgb.shape[0] * rgb.shape[1] > self.memory:
            raise MemoryError("too large")
        self.seen.append(rgb.shape[:2])
        small = rgb[2::4, 2::4, 0]
        index = np.clip(np.round(small / 20.0), 0, len(self.info.labels) - 1).astype(int)
        return np.eye(len(self.info.labels), dtype=np.float32)[index].transpose(2, 0, 1)


def painted(camera: Camera, classes: int = 12) -> tuple[U8, npt.NDArray[np.int64]]:
    """A photo of vertical stripes of all classes, and each pixel's class."""
    index = np.tile(np.arange(camera.width) * classes // camera.width, (camera.height, 1))
    return np.repeat((index * 20).astype(np.uint8)[..., None], 3, axis=2), index


def test_class_map_equals_the_true_classes() -> None:
    rgb, truth = painted(PINHOLE)
    best, confidence = class_map(Classifier(ByColour(), "").probabilities(rgb, PINHOLE), rgb.shape[:2])
    assert (best == truth).mean() > 0.95
    assert confidence[best == truth].mean() > 230


@pytest.mark.parametrize("camera", [Camera("pinhole", 3000, 2000, 500.0, 500.0, 1499.5, 999.5)])
def test_large_photos_are_classified_in_tiles_without_seams(camera: Camera) -> None:
    rgb, truth = painted(camera)
    network = ByColour()
    classifier = Classifier(network, "")
    best, _ = class_map(classifier.probabilities(rgb, camera), rgb.shape[:2])
    assert (best == truth).mean() > 0.97
    assert len(network.seen) > 1 and max(max(size) for size in network.seen) <= classifier.tile


def test_tiles_are_reduced_when_memory_is_insufficient() -> None:
    rgb, truth = painted(PINHOLE)
    network = ByColour(memory=400 * 400)
    classifier = Classifier(network, "")
    best, _ = class_map(classifier.probabilities(rgb, PINHOLE), rgb.shape[:2])
    assert (best == truth).mean() > 0.93 and classifier.tile < 500
    with pytest.raises(MemoryError):
        Classifier(ByColour(memory=100), "").probabilities(rgb, PINHOLE)


def test_photos_are_resampled_to_the_networks_angular_resolution() -> None:
    network = ByColour(resolution=250.0)
    rgb, _ = painted(PINHOLE)
    Classifier(network, "").probabilities(rgb, PINHOLE)
    assert network.seen == [(240, 320)]


@pytest.mark.parametrize("camera", [PINHOLE, PANORAMA])
def test_lidar_channels_are_passed_after_the_colours(camera: Camera) -> None:
    class ByChannel(ByColour):
        def probabilities(self, seen: U8) -> F32:
            assert seen.shape[2] == 7
            return super().probabilities(np.ascontiguousarray(seen[..., 3:]))

    network = ByChannel(resolution=camera.fx or camera.width / (2 * np.pi))
    network.info = replace(network.info, channels=True)
    rgb, truth = painted(camera)
    channels = np.zeros((camera.height // 4, camera.width // 4, 4), np.uint8)
    channels[..., 0] = 20 * truth[2::4, 2::4]
    classifier = Classifier(network, "")
    assert (class_map(classifier.probabilities(0 * rgb, camera, channels), truth.shape)[0] == truth).mean() > 0.9
    assert (class_map(classifier.probabilities(rgb, camera), truth.shape)[0] == 0).all(), (
        "channels are 0 without a scan"
    )


def test_panoramas_have_no_seam() -> None:
    network = ByColour(resolution=PANORAMA.width / (2 * np.pi))
    rgb, truth = painted(PANORAMA)
    best, _ = class_map(Classifier(network, "").probabilities(rgb, PANORAMA), rgb.shape[:2])
    assert (best == truth).mean() > 0.95
    assert {size[1] for size in network.seen} == {1024 + 2 * TILE_OVERLAP_PX}, "each side is extended by the other"


def test_other_label_sets_are_mapped_by_name() -> None:
    cityscapes = [
        "road",
        "sidewalk",
        "building",
        "wall",
        "fence",
        "pole",
        "traffic light",
        "traffic sign",
        "vegetation",
    ]
    assert [CLASSES[i] for i in map_labels(cityscapes, "")] == [
        "road", "sidewalk", "building", "wall_or_fence", "wall_or_fence", "pole", "road_sign", "road_sign",
        "high_vegetation",
    ]  # fmt: skip
    ade = ["wall", "building, edifice", "sky", "floor, flooring", "tree", "ceiling", "road, route", "bed", "grass"]
    assert map_labels(ade, "")[5] == IGNORED and CLASSES[map_labels(ade, "")[4]] == "high_vegetation"
    with pytest.raises(InputError, match="unknown label set"):
        map_labels(["cat", "dog"], "pets.onnx")


def test_all_labels_map_to_classes_and_codes_round_trip() -> None:
    assert all(ours in CLASSES for table in LABEL_SETS.values() for ours in table.values())
    assert index_of_code()[code_of_index()].tolist() == list(range(len(CLASSES)))
