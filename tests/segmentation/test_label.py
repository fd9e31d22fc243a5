"""Step `label` with networks and label images of users: mistakes are reported, every file that is read counts."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Camera, Frame, PointCloud, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.segmentation.huggingface import network_files
from scan2sim.segmentation.label_images import LabelImages
from scan2sim.segmentation.labels import CLASSES
from scan2sim.segmentation.steps.label import LABEL, LabelParams
from tests.segmentation.backends.test_onnx import LABELS, write

ROOT = Path(__file__).parents[2]
pytest.importorskip("onnxruntime", reason="runs the networks")


@pytest.fixture
def inputs(tmp_path: Path) -> dict[str, Path]:
    """Two photos and an empty cloud."""
    views = []
    for i in range(2):
        photo = tmp_path / f"{i}.png"
        cv2.imwrite(str(photo), np.random.default_rng(i).integers(0, 256, (48, 64, 3), np.uint8))
        views.append(View(photo.name, Camera("pinhole", 64, 48, 50.0, 50.0, 31.5, 23.5), np.eye(4), photo))
    views_io.save(tmp_path / "views.json", views)
    PointCloud(Frame(), np.zeros((1, 3), np.float32)).save(tmp_path / "cloud.npz")
    return {"views": tmp_path / "views.json", "cloud": tmp_path / "cloud.npz"}


def run(inputs: dict[str, Path], weights: Path) -> Done:
    out = weights.parent / "out"
    out.mkdir()
    return LABEL.run(inputs, LabelParams(network="onnx", weights=weights), out, silent)


def test_network_that_fails_on_every_photo_ends_the_run(inputs: dict[str, Path], tmp_path: Path) -> None:
    weights = write(tmp_path / "net.onnx", labels=[*LABELS, "person"])
    with pytest.raises(InputError, match="for 5 labels") as caught:
        run(inputs, weights)
    assert caught.value.where == str(weights)


def test_damaged_photo_is_left_out(inputs: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "0.png").write_bytes(b"")
    done = run(inputs, write(tmp_path / "net.onnx", mean="[0, 0, 0]", std="[1, 1, 1]"))
    assert done.metrics["photos"] == 1 and len(done.warnings) == 1 and "0.png" in done.warnings[0]


def test_assumed_normalisation_is_a_warning(inputs: dict[str, Path], tmp_path: Path) -> None:
    (warning,) = run(inputs, write(tmp_path / "net.onnx")).warnings
    assert "net.onnx" in warning and "RGB with ImageNet's mean" in warning and "preprocessor_config.json" in warning


def test_unknown_labels_are_rejected_with_the_names_that_fit(inputs: dict[str, Path], tmp_path: Path) -> None:
    weights = write(tmp_path / "net.onnx", labels=["LABEL_0", "LABEL_1", "LABEL_2", "LABEL_3"])
    with pytest.raises(InputError, match=r"unknown label set .*name their labels after the classes road, sidewalk"):
        run(inputs, weights)


def labels(folder: Path, images: dict[str, np.ndarray], names: str = "") -> Path:
    """Write label images, and `labels.txt` with these names."""
    folder.mkdir()
    for name, values in images.items():
        path = folder / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), values.astype(np.uint8))
    if names:
        (folder / "labels.txt").write_text("\n".join(names.split()), encoding="utf-8")
    return folder


TRUTH = np.repeat(np.arange(4), 6)[None].repeat(18, axis=0)  # four stripes, of other than the photo's size
LAS_TRUTH = np.array([11, 6, 5, 0])[TRUTH]


def best_of(done: Done, i: int) -> list[str]:
    """Class in the middle of each stripe of a photo, "" for none."""
    found = np.load(done.files["labels"] / f"{i}.npy")
    assert found.shape == (12, 16, len(CLASSES))
    middle = found[6, [2, 6, 10, 14]]
    return [CLASSES[one.argmax()] if one.max() else "" for one in middle]


def by_images(inputs: dict[str, Path], folder: Path) -> Done:
    (folder / "out").mkdir()
    return LABEL.run(inputs, LabelParams(images=folder), folder / "out", silent)


def test_label_images_replace_the_network(inputs: dict[str, Path], tmp_path: Path) -> None:
    names = "road building vegetation void sky"
    done = by_images(inputs, labels(tmp_path / "masks", {"0": TRUTH, "1": TRUTH[:, ::-1]}, names))
    assert best_of(done, 0) == ["road", "building", "high_vegetation", ""]
    assert best_of(done, 1) == ["", "high_vegetation", "building", "road"]
    assert done.metrics["photos"] == 2 and not done.warnings
    assert done.metrics["classes"] == ("road", "building", "high_vegetation", "sky")


def test_label_images_may_have_only_some_classes(inputs: dict[str, Path], tmp_path: Path) -> None:
    done = by_images(inputs, labels(tmp_path / "masks", {"0": TRUTH, "1": TRUTH}, "void vehicle person void"))
    assert best_of(done, 0) == ["", "vehicle", "person", ""] and not done.warnings
    with pytest.raises(InputError, match="unknown label set"):
        LabelImages(labels(tmp_path / "unknown", {"0": TRUTH}, "a b c d"), views_io.load(inputs["views"]))


def test_label_images_without_names_are_las_codes(inputs: dict[str, Path], tmp_path: Path) -> None:
    done = by_images(inputs, labels(tmp_path / "masks", {"0": LAS_TRUTH}))
    assert best_of(done, 0) == ["road", "building", "high_vegetation", "sky"]
    assumed, missing = done.warnings
    assert "read as LAS codes (11 road, 6 building" in assumed and "labels.txt" in assumed
    assert done.metrics["photos"] == 1 and "1.png: no label image in" in missing


@pytest.mark.parametrize(
    ("images", "error", "cause"),
    [
        ({"0": TRUTH + 6, "1": TRUTH + 6}, DataError, "values that are no classes of photos: 7, 8, 9"),
        ({"other": LAS_TRUTH}, InputError, "has no label image of any photo, such as 0.png"),
    ],
)
def test_unsuitable_label_images_are_rejected(
    inputs: dict[str, Path], tmp_path: Path, images: dict[str, np.ndarray], error: type[Exception], cause: str
) -> None:
    with pytest.raises(error, match=cause):
        by_images(inputs, labels(tmp_path / "masks", images))


def test_label_image_of_a_crop_is_left_out(inputs: dict[str, Path], tmp_path: Path) -> None:
    done = by_images(inputs, labels(tmp_path / "masks", {"0": LAS_TRUTH[:12], "1": LAS_TRUTH}))
    assert done.metrics["photos"] == 1 and "24 x 12 pixels don't have the proportions" in done.warnings[1]


def test_label_images_that_the_clouds_classes_replace_are_a_warning(inputs: dict[str, Path], tmp_path: Path) -> None:
    PointCloud(Frame(), np.zeros((1, 3), np.float32), classification=np.array([6], np.uint8)).save(inputs["cloud"])
    done = by_images(inputs, labels(tmp_path / "masks", {"0": LAS_TRUTH}))
    (warning,) = done.warnings
    assert "masks isn't used: the cloud keeps its classes" in warning and "segment.overwrite=true" in warning


def test_photos_outside_of_the_tile_are_not_taken_for_their_label_images(tmp_path: Path) -> None:
    camera = Camera("pinhole", 64, 48, 50.0, 50.0, 31.5, 23.5)
    folder = labels(tmp_path / "masks", {"1": LAS_TRUTH})
    photo = labels(tmp_path / "photos", {"1": LAS_TRUTH}) / "1.png"
    for name in ("../photos/1", str(photo.with_suffix(""))):
        assert LabelImages(folder, [View(name, camera, np.eye(4), photo)]).files == {name: folder / "1.png"}


def test_photos_of_several_cameras_have_label_images_in_folders(tmp_path: Path) -> None:
    camera = Camera("pinhole", 64, 48, 50.0, 50.0, 31.5, 23.5)
    views = [View(f"photos/{side}/1", camera, np.eye(4), tmp_path / "1.jpg") for side in ("left", "right")]
    folder = labels(tmp_path / "a", {"left/1": LAS_TRUTH, "right/1": LAS_TRUTH})
    assert [path.parent.name for path in LabelImages(folder, views).files.values()] == ["left", "right"]
    with pytest.raises(InputError, match="label image of 2 photos"):
        LabelImages(labels(tmp_path / "b", {"1": LAS_TRUTH}), views)


def test_files_beside_the_weights_are_inputs_of_the_step(tmp_path: Path) -> None:
    tile = read_tile(ROOT / "data_samples" / "tile")

    def files(weights: Path) -> set[object]:
        tasks = build_graph(tile, Settings({"label": {"network": "onnx", "weights": str(weights)}}))
        (label,) = (task for task in tasks if task.step is LABEL)
        return {source for name, source in label.inputs.items() if name.startswith("weights")}

    (tmp_path / "onnx").mkdir()
    weights = write(tmp_path / "onnx" / "net.onnx")
    (tmp_path / "onnx" / "other.labels.txt").write_text("road", encoding="utf-8")
    assert files(weights) == {weights}
    beside = [tmp_path / "onnx" / "net.labels.txt", tmp_path / "onnx" / "net.onnx.data", tmp_path / "config.json"]
    for file in beside:
        file.write_text("", encoding="utf-8")
    assert files(weights) == {weights, *beside}


def test_label_images_are_inputs_of_the_step(tmp_path: Path) -> None:
    tile = read_tile(ROOT / "data_samples" / "tile")
    stem = Path(tile.views[0].name).name
    folder = labels(tmp_path / "masks", {stem: LAS_TRUTH, "other": LAS_TRUTH}, "road sky building car")
    tasks = build_graph(tile, Settings({"label": {"images": str(folder)}}))
    (label,) = (task for task in tasks if task.step is LABEL)
    assert {folder / f"{stem}.png", folder / "labels.txt"} <= set(label.inputs.values())
    assert folder / "other.png" not in label.inputs.values()
    assert LABEL.check is not None
    with pytest.raises(InputError, match="folder not found"):
        LABEL.check(LabelParams(images=tmp_path / "none"))


def test_files_of_a_folder_of_weights_are_found(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("model.safetensors", "config.json", "preprocessor_config.json")]
    for file in files:
        file.write_text("{}", encoding="utf-8")
    (tmp_path / "README.md").write_text("", encoding="utf-8")
    assert network_files(tmp_path) == files
