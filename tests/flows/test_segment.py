"""`scan2sim segment` on the command line, with the bundled network."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest

from scan2sim.flows.commands.segment import _write_clouds, short_names
from scan2sim.pipeline.core.types import Frame, PointCloud, Tile
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.segmentation.metrics import confusion
from tests.flows.command import assert_fails, in_process, stdout_of
from tests.flows.tiny import tiny


@pytest.fixture(scope="module")
def segmented(small_street: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Output folder of the small street, classified with --overwrite, and the printed text."""
    out = tmp_path_factory.mktemp("segmented")
    return out, stdout_of(in_process("segment", small_street, "--out", out, "--overwrite"))


def test_points_are_classified_from_the_photos(small_street: Path, segmented: tuple[Path, str]) -> None:
    out, printed = segmented
    tile = read_tile(small_street)
    before = las.read(tile.clouds[0], tile.frame)
    after = las.read(out / "classified" / "cloud.laz", tile.frame)
    np.testing.assert_array_equal(before.xyz, after.xyz)
    np.testing.assert_array_equal(before.time, after.time)
    assert before.classification is not None and after.classification is not None
    iou = confusion(before.classification, after.classification).iou
    assert iou["road"] > 0.8 and iou["building"] > 0.85 and iou["high_vegetation"] > 0.8
    assert "known as" in printed and "road_sign" in printed


def test_label_images_and_masks_are_written(small_street: Path, segmented: tuple[Path, str]) -> None:
    out, _ = segmented
    for view in read_tile(small_street).views:
        codes = cv2.imread(str(out / "labels" / f"{view.photo.stem}.png"), cv2.IMREAD_GRAYSCALE)
        mask = cv2.imread(str(out / "masks" / f"{view.photo.stem}.png"), cv2.IMREAD_GRAYSCALE)
        assert codes.shape == mask.shape == (view.camera.height, view.camera.width)
        np.testing.assert_array_equal(mask == 0, np.isin(codes, (0, 66, 67)))


def test_run_reuses_the_segmentation(small_street: Path, segmented: tuple[Path, str]) -> None:
    out, _ = segmented
    plan = stdout_of(in_process("plan", small_street, "--out", out, "--set", "segment.overwrite=true"))
    again = {line.split()[0] for line in plan.splitlines() if " yes " in line}
    assert "split" in again and not again & {"label", "segment", "ingest"}


def test_existing_classes_are_kept(small_street: Path, tmp_path: Path) -> None:
    street = tiny(small_street, tmp_path / "street")
    stdout_of(in_process("segment", street, "--out", tmp_path / "out"))
    tile = read_tile(street)
    before = las.read(tile.clouds[0], tile.frame)
    after = las.read(tmp_path / "out" / "classified" / "cloud.laz", tile.frame)
    assert before.classification is not None and after.classification is not None
    np.testing.assert_array_equal(before.classification, after.classification)
    assert not list((tmp_path / "out" / "labels").glob("*.png"))


def test_results_of_files_with_the_same_name_have_different_names() -> None:
    assert short_names(["photos/1.jpg", "photos/2.jpg"]) == ["1", "2"]
    assert short_names(["photos/IMG.1.jpg", "photos/IMG.2.jpg"]) == ["IMG.1", "IMG.2"]
    assert short_names(["photos/left/1.jpg", "photos/right/1.jpg"]) == ["photos/left/1", "photos/right/1"]
    assert short_names(["../a.las", "../b/A.laz"]) == ["a", "b/A"], "file systems may not distinguish a from A"
    assert short_names(["a.las", "a.laz"]) == ["a.las", "a.laz"]


def test_bad_weights_keep_earlier_results(small_street: Path, segmented: tuple[Path, str], tmp_path: Path) -> None:
    out, _ = segmented
    before = (out / "classified" / "cloud.laz").read_bytes()
    (tmp_path / "w.pt").write_bytes(pickle.dumps({"x": 1}))
    command = ("segment", small_street, "--out", out, "--overwrite", "--set")
    assert_fails(in_process(*command, f"label.weights={tmp_path / 'w.pt'}"), 3, "w.pt", "safetensors")
    assert_fails(in_process(*command, f"label.weights={tmp_path / 'no.safetensors'}"), 3, "no.safetensors")
    assert_fails(in_process(*command, "label.network=deeplab"), 2, "deeplab", "segformer")
    assert (out / "classified" / "cloud.laz").read_bytes() == before


def test_evaluate_compares_pixels_with_labels(small_street: Path, tmp_path: Path) -> None:
    from scan2sim.data_samples.street import generate

    generate(tmp_path / "tile", length=10, points=20_000, photos=4, seed=8, photo_width=320, photo_labels=True)
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "images").symlink_to(tmp_path / "tile" / "photos")
    (tmp_path / "set" / "labels").symlink_to(tmp_path / "tile" / "truth" / "labels")
    printed = stdout_of(in_process("segment", "evaluate", tmp_path / "set"))
    values = {line.split()[0]: float(line.split()[1]) for line in printed.splitlines() if len(line.split()) == 2}
    assert values["road"] > 0.6 and values["building"] > 0.6 and 0 < values["mean"] < 1


def test_withheld_points_keep_the_class_of_the_file(tmp_path: Path) -> None:
    cloud = tmp_path / "c.laz"
    las.write(
        cloud, PointCloud(Frame(), np.zeros((5, 3), np.float32), classification=np.array([2, 6, 2, 6, 2], np.uint8))
    )
    data = laspy.read(cloud)
    data.withheld = np.array([0, 1, 0, 0, 1])
    data.write(cloud)
    columns = (np.array(values, np.uint8) for values in ((5, 11, 66), (7, 8, 9), (1, 1, 2)))
    _write_clouds(Tile(tmp_path / "tile.toml", "t", Frame(), (cloud,)), tmp_path / "out", *columns)
    done = laspy.read(tmp_path / "out" / "c.laz")
    assert np.array_equal(done.classification, [5, 6, 11, 66, 2])
    assert np.array_equal(done.confidence, [7, 255, 8, 9, 255])
