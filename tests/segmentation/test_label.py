"""Step `label` with networks of users: their mistakes are reported, and every file that they are read from counts."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.tile import build_graph
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Camera, Frame, PointCloud, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.segmentation.huggingface import network_files
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


def test_files_of_a_folder_of_weights_are_found(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("model.safetensors", "config.json", "preprocessor_config.json")]
    for file in files:
        file.write_text("{}", encoding="utf-8")
    (tmp_path / "README.md").write_text("", encoding="utf-8")
    assert network_files(tmp_path) == files
