"""`scan2sim toolbox train`: from a tile with a lidar's cloud and photos to a detector."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scan2sim.services.toolboxes.detector import dataset
from scan2sim.services.toolboxes.tasks import detect
from tests.conftest import ROOT
from tests.flows.command import assert_fails, in_process, stdout_of

pytestmark = pytest.mark.usefixtures("steps_in_process")

pytest.importorskip("torch")
TILE = ROOT / "data_samples" / "tile"


def test_detector_is_trained_on_a_drive_and_evaluated_on_another(tmp_path: Path) -> None:
    options = ("--steps", 1, "--synthetic", 0, "--out", tmp_path)
    printed = stdout_of(in_process("toolbox", "train", "--drives", TILE, "--held-out", TILE, *options))
    assert "vehicles.onnx" in printed
    images, names = dataset.read(tmp_path / "labels")
    learned = sum(int((one.visible > dataset.MIN_VISIBLE_SHARE).sum()) for one in images)
    assert learned > 0 and names[0] == "car"
    assert {"recall", "precision", "threshold", "vehicles"} == set(json.loads((tmp_path / "figures.json").read_text()))
    model = detect.load(detect.Params(weights=tmp_path / "vehicles.onnx"))
    assert "your drives" in model.info.licence
    (body,) = model([np.zeros((90, 160, 3), np.uint8)])
    assert isinstance(body.threshold, dict) and body.threshold["person"] == 0.5


def test_drive_without_photos_is_refused(tmp_path: Path) -> None:
    text = (TILE / "tile.toml").read_text(encoding="utf-8")
    (tmp_path / "cloud.laz").symlink_to(TILE / "cloud.laz")
    (tmp_path / "trajectory.csv").symlink_to(TILE / "trajectory.csv")
    (tmp_path / "tile.toml").write_text(text[: text.index("[truth]")], encoding="utf-8")
    assert_fails(in_process("toolbox", "train", "--drives", tmp_path, "--out", tmp_path / "out"), 3, "has no photos")
