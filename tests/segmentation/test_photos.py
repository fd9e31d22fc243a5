"""Classification of photos of any size and camera, with a fake network that predicts a pixel's class by its colour."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8, Camera, View
from scan2sim.segmentation.backends import NetworkInfo
from scan2sim.segmentation.labels import CLASSES, IGNORED, LABEL_SETS, code_of_index, index_of_code, map_labels
from scan2sim.segmentation.photos import TILE_OVERLAP_PX, Classifier, class_map, quarter_turns

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


@pytest.mark.parametrize(
    ("size", "fixed", "tile"),
    [
        ((1920, 1080), (512, 1024), (768, 1536)),
        ((1920, 1080), (512, 512), (1080, 1080)),
        ((1080, 1920), (512, 1024), (540, 1080)),
        ((300, 200), (1024, 2048), (148, 300)),
        ((1242, 375), (512, 512), (375, 372)),
        ((1920, 1080), None, (1080, 1536)),
    ],
)
def test_tiles_have_the_proportions_of_a_fixed_input(
    size: tuple[int, int], fixed: tuple[int, int] | None, tile: tuple[int, int]
) -> None:
    camera = Camera("pinhole", *size, 500.0, 500.0, (size[0] - 1) / 2, (size[1] - 1) / 2)
    rgb, truth = painted(camera)
    network = ByColour()
    network.info = replace(network.info, size=fixed)
    best, _ = class_map(Classifier(network, "").probabilities(rgb, camera), rgb.shape[:2])
    assert set(network.seen) == {tile} and (best == truth).mean() > 0.9 and (best != IGNORED).all()


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
    ade += ["building", "car", "person", "sidewalk", "plant", "bench", "lamp", "tent"]
    assert map_labels(ade, "")[-3:].tolist() == [IGNORED] * 3, "buildings and poles of other sets"
    with pytest.raises(InputError, match="unknown label set"):
        map_labels(["cat", "dog"], "pets.onnx")


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("Sky Building Pole Road Pavement Tree SignSymbol Fence Car Pedestrian Bicyclist",  # CamVid
         "sky building pole road sidewalk high_vegetation road_sign wall_or_fence vehicle person person"),
        ("construction--flat--road construction--structure--building object--traffic-sign--front human--person "
         "object--vehicle--on-rails marking--general object--support--utility-pole nature--vegetation",  # Vistas
         "road building road_sign person vehicle road pole high_vegetation"),
        ("person traffic_light road pavement-merged building-other-merged tree-merged sky-other-merged wall-brick",
         "person road_sign road sidewalk building high_vegetation sky wall_or_fence"),  # COCO panoptic
        ("road ground smallpole garage gate vegetation", "road road pole building wall_or_fence high_vegetation"),
    ],
)  # fmt: skip
def test_spellings_of_label_sets_are_known(names: str, expected: str) -> None:
    assert [CLASSES[i] for i in map_labels(names.split(), "")] == expected.split()


def test_labels_of_things_only_are_rejected() -> None:
    """Networks for instances of COCO have five of our classes, but neither ground nor buildings."""
    with pytest.raises(InputError, match="unknown label set"):
        map_labels(["person", "bicycle", "car", "traffic light", "fire hydrant", "bench", "potted plant", "boat"], "")
    with pytest.raises(InputError, match="unknown label set"):
        map_labels(["sky", "building", "vegetation", "car"], "")


def test_photos_that_show_labels_without_a_class_give_a_warning() -> None:
    rgb, index = painted(PINHOLE)
    network = ByColour(("road", "asphalt", "building", "sky", "car", "void", *["tree"] * 6))
    classifier = Classifier(network, "")
    classifier.probabilities(np.where(index[..., None] == 5, 20, rgb).astype(np.uint8), PINHOLE)
    (warning,) = classifier.warnings()
    assert "by colour: " in warning and "don't count: asphalt (17%). " in warning and "road, sidewalk" in warning
    sure = Classifier(ByColour(), "")
    sure.probabilities(rgb, PINHOLE)
    assert sure.warnings() == []


def test_all_labels_map_to_classes_and_codes_round_trip() -> None:
    assert all(ours in CLASSES for table in LABEL_SETS.values() for ours in table.values())
    indices = list(range(len(CLASSES)))
    assert index_of_code()[code_of_index()[indices]].tolist() == indices and code_of_index()[IGNORED] == IGNORED


def test_pixels_of_labels_without_a_class_have_none() -> None:
    rgb, truth = painted(PINHOLE)
    network = ByColour((*CLASSES[:5], "void", *CLASSES[6:]))
    best, _ = class_map(Classifier(network, "").probabilities(rgb, PINHOLE), rgb.shape[:2])
    assert (best == np.where(truth == 5, IGNORED, truth)).mean() > 0.95


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_photos_of_a_camera_on_its_side_are_classified_upright(turns: int) -> None:
    class ByHeight(ByColour):
        """Predicts the first class in the upper half of what it is given, and the last one below."""

        def probabilities(self, seen: U8) -> F32:
            height, width = seen.shape[0] // 4, seen.shape[1] // 4
            out = np.zeros((len(CLASSES), height, width), np.float32)
            out[0, : height // 2], out[-1, height // 2 :] = 1, 1
            self.seen.append(seen.shape)
            return out

    upright = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # looks along x
    angle = -turns * np.pi / 2
    roll = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = upright @ roll
    camera = PINHOLE if turns % 2 == 0 else replace(PINHOLE, width=480, height=640, cx=239.5, cy=319.5)
    assert quarter_turns(View("a", camera, pose, Path("a.jpg"))) == turns
    network = ByHeight()
    rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
    found = Classifier(network, "").probabilities(rgb, camera, turns=turns)
    assert network.seen[0][:2] == (480, 640)
    v, u = np.mgrid[: found.shape[0], : found.shape[1]].astype(float)
    rays = np.stack([u - (found.shape[1] - 1) / 2, v - (found.shape[0] - 1) / 2, np.full(u.shape, 125.0)], axis=-1)
    above = (rays @ pose[:3, :3].T)[..., 2] > 0
    assert ((found[..., 0] > 127) == above).mean() > 0.98 and ((found[..., -1] > 127) == ~above).mean() > 0.98


@pytest.mark.parametrize("camera", [PINHOLE, PANORAMA])
def test_cameras_without_an_upright_photo_are_not_turned(camera: Camera) -> None:
    down = np.eye(4)
    down[:3, :3] = np.diag([1.0, -1.0, -1.0])
    if camera is PANORAMA:
        down[:3, :3] = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])  # its right side up
    assert quarter_turns(View("a", camera, down, Path("a.jpg"))) == 0
