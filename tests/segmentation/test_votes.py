"""Classification of points by photos on the synthetic street, with photos labelled by ground truth."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import U8, PointCloud
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.segmentation.labels import CLASSES, index_of_code
from scan2sim.segmentation.metrics import confusion
from scan2sim.segmentation.steps.label import LABEL, LabelParams
from scan2sim.segmentation.steps.segment import SEGMENT, SegmentParams
from tests.present import present


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, U8]:
    """Folder with a street's cloud without classes and its photos' true labels as probabilities; true point classes."""
    from scan2sim.data_samples.street import generate

    folder = tmp_path_factory.mktemp("labelled")
    tile = read_tile(
        generate(folder / "tile", length=20, points=250_000, photos=12, seed=3, photo_width=640, photo_labels=True)
    )
    cloud = las.read(tile.clouds[0], tile.frame)
    PointCloud(cloud.frame, cloud.xyz, cloud.rgb, time=cloud.time).save(folder / "cloud.npz")
    present(tile.trajectory).save(folder / "path.npz")
    views_io.save(folder / "views.json", tile.views)
    (folder / "labels").mkdir()
    for i, view in enumerate(tile.views):
        codes = cv2.imread(str(folder / "tile/truth/labels" / f"{view.photo.stem}.png"), cv2.IMREAD_GRAYSCALE)
        index = index_of_code()[codes[::2, ::2]]
        np.save(folder / "labels" / f"{i}.npy", np.uint8(255) * (index[..., None] == np.arange(len(CLASSES))))
    (folder / "labels" / "network.json").write_text(json.dumps({"classes": CLASSES}), encoding="utf-8")
    return folder, present(cloud.classification)


def segment(
    folder: Path, out: Path, names: tuple[str, ...] = ("views", "labels", "path"), **params: Any
) -> tuple[U8, dict[str, U8], Done]:
    files = {"views": "views.json", "labels": "labels", "path": "path.npz"}
    inputs = {"cloud": folder / "cloud.npz"} | {name: folder / files[name] for name in names}
    done = SEGMENT.run(inputs, SegmentParams(**params), out, silent)

    with np.load(done.files["confidence"]) as point_confidence:
        return present(PointCloud.load(done.files["cloud"]).classification), dict(point_confidence), done


def test_correctly_labelled_photos_give_correct_points(labelled: tuple[Path, U8], tmp_path: Path) -> None:
    folder, truth = labelled
    (tmp_path / "photos").mkdir()
    (tmp_path / "shape").mkdir()
    predicted, point_confidence, done = segment(folder, tmp_path / "photos")
    found = confusion(truth, predicted)
    print(found.table())
    assert found.mean() > 0.85 and found.iou["road_sign"] > 0.6 and found.iou["road"] > 0.93
    shape, *_ = segment(folder, tmp_path / "shape", photos=False)
    assert found.mean() > confusion(truth, shape).mean() + 0.15
    assert done.metrics["sky_share"] < 0.08 and done.metrics["seen_share"] > 0.5
    confidence, source = point_confidence["confidence"], point_confidence["source"]
    right = predicted == truth
    assert confidence[right].mean() > confidence[~right].mean() + 20, "confidence is higher where classes are right"
    assert set(np.unique(source)) <= {1, 2} and (right[source == 1].mean()) > right[source == 2].mean()


def test_wrong_poses_raise_the_sky_share(labelled: tuple[Path, U8], tmp_path: Path) -> None:
    folder, _ = labelled
    views = list(views_io.load(folder / "views.json"))
    for view in views:
        view.T_world_cam[:3, :3] = view.T_world_cam[:3, :3] @ np.array([[1, 0, 0], [0, 0.9, 0.43], [0, -0.43, 0.9]])
    views_io.save(tmp_path / "views.json", views)
    done = SEGMENT.run(
        {"cloud": folder / "cloud.npz", "views": tmp_path / "views.json", "labels": folder / "labels"},
        SEGMENT.params(), tmp_path, silent,
    )  # fmt: skip
    assert done.metrics["sky_share"] > 0.15 and any("poses" in w for w in done.warnings)


def test_single_vegetation_class_is_split_by_height(labelled: tuple[Path, U8], tmp_path: Path) -> None:
    folder, truth = labelled
    labels = tmp_path / "labels"
    labels.mkdir()
    low, high = CLASSES.index("low_vegetation"), CLASSES.index("high_vegetation")
    for file in (folder / "labels").glob("*.npy"):
        p = np.load(file)
        p[..., high], p[..., low] = p[..., high] | p[..., low], 0
        np.save(labels / file.name, p)
    (labels / "network.json").write_text(
        json.dumps({"classes": [c for c in CLASSES if c != "low_vegetation"]}), encoding="utf-8"
    )
    inputs = {"cloud": folder / "cloud.npz", "views": folder / "views.json", "labels": labels}
    done = SEGMENT.run(inputs, SEGMENT.params(), tmp_path, silent)

    iou = confusion(truth, present(PointCloud.load(done.files["cloud"]).classification)).iou
    assert iou["low_vegetation"] > 0.5 and iou["high_vegetation"] > 0.85


def test_points_are_classified_by_shape_without_labelled_photos(labelled: tuple[Path, U8], tmp_path: Path) -> None:
    folder, _ = labelled
    (tmp_path / "labels").mkdir()
    done = SEGMENT.run(
        {"cloud": folder / "cloud.npz", "views": folder / "views.json", "labels": tmp_path / "labels"},
        SEGMENT.params(), tmp_path, silent,
    )  # fmt: skip
    assert done.metrics["source"] == "shape" and any("shape alone" in w for w in done.warnings)


def test_existing_classes_are_kept_and_photos_not_classified(labelled: tuple[Path, U8], tmp_path: Path) -> None:
    folder, truth = labelled
    cloud = PointCloud.load(folder / "cloud.npz")
    PointCloud(cloud.frame, cloud.xyz, classification=truth).save(tmp_path / "own.npz")
    for name in ("label", "kept"):
        (tmp_path / name).mkdir()
    inputs = {"cloud": tmp_path / "own.npz", "views": folder / "views.json"}
    done = LABEL.run(inputs, LabelParams(network="nonsense"), tmp_path / "label", silent)
    assert done.metrics["photos"] == 0 and "classes" in done.metrics["why"]
    kept = SEGMENT.run(inputs | {"labels": done.files["labels"]}, SEGMENT.params(), tmp_path / "kept", silent)
    np.testing.assert_array_equal(PointCloud.load(kept.files["cloud"]).classification, truth)


def test_ground_is_split_into_road_sidewalk_and_terrain(labelled: tuple[Path, U8], tmp_path: Path) -> None:
    folder, _ = labelled
    predicted, *_ = segment(folder, tmp_path)
    assert {CODE[n] for n in ("road", "sidewalk", "terrain", "building", "high_vegetation")} <= set(predicted.tolist())


def test_missing_weights_are_reported(tmp_path: Path) -> None:
    from scan2sim.segmentation.backends import load

    with pytest.raises(InputError, match=r"no\.safetensors"):
        load("street", tmp_path / "no.safetensors")
