"""The project's own detector: dataset, losses, export, and accuracy of the trained network."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scan2sim.data_samples import boxes
from scan2sim.pipeline.core.errors import DataError
from scan2sim.services.toolboxes import yolo
from scan2sim.services.toolboxes.detector import dataset
from scan2sim.services.toolboxes.detector.metrics import GroundTruth, Predictions, average_precision
from tests.conftest import ROOT

onnxruntime = pytest.importorskip("onnxruntime")
torch = pytest.importorskip("torch")

OWN = ROOT / "services" / "toolboxes" / "weights" / "vehicles.onnx"


@pytest.fixture(scope="module")
def dataset_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Dataset of a crossing and a street that the network was not trained on."""
    out = tmp_path_factory.mktemp("boxes")
    for _ in boxes.write(out, 60, 500, processes=1):
        pass
    return out


def test_dataset_has_boxes_and_generation_resumes(dataset_folder: Path) -> None:
    found, names = dataset.read(dataset_folder)
    before = (dataset_folder / "boxes.jsonl").read_text(encoding="utf-8")
    for _ in boxes.write(dataset_folder, 60, 500, processes=1):
        pass
    assert (dataset_folder / "boxes.jsonl").read_text(encoding="utf-8") == before
    assert {"car", "train"} <= {names[int(k)] for one in found for k in one.classes}
    rng = np.random.default_rng(0)
    for one in found[::7]:
        image, objects, ignored = dataset.augmented_crop(one, (256, 320), rng)
        assert image.shape == (256, 320, 3) and image.min() >= 0 and image.max() <= 1
        for corners in (objects[:, :4], ignored):
            assert (corners >= 0).all() and (corners <= [320, 256, 320, 256]).all()
            assert (corners[:, 2:] > corners[:, :2]).all()


def test_boxes_are_augmented_with_the_image(tmp_path: Path) -> None:
    import cv2

    rgb = np.full((384, 640, 3), 20, np.uint8)
    rgb[100:180, 300:420] = 255
    cv2.imwrite(str(tmp_path / "a.png"), rgb)
    box = np.array([[300, 100, 420, 180]], np.float32)
    one = dataset.LabelledImage(tmp_path / "a.png", box, np.zeros(1, np.float32), np.ones(1, np.float32))
    visible = 0
    for seed in range(20):
        image, objects, _ = dataset.augmented_crop(one, (320, 384), np.random.default_rng(seed))
        if not len(objects):
            continue
        x0, y0, x1, y1 = np.round(objects[0, :4]).astype(int)
        grey = image.mean(axis=2)
        inner = grey[y0 + 2 : y1 - 2, x0 + 2 : x1 - 2].mean()
        rim = [grey[max(y0 - 8, 0) : max(y0 - 4, 0), x0:x1], grey[y0:y1, max(x0 - 8, 0) : max(x0 - 4, 0)]]
        around = [r.mean() for r in rim if r.size]
        visible += bool(around)
        assert all(inner > a for a in around), seed
    assert visible > 8


def test_each_box_is_assigned_to_cells_near_its_centre() -> None:
    from scan2sim.services.toolboxes.detector.network import assign_targets, cells

    centres, stride = cells(384, 640)
    rng = np.random.default_rng(3)
    low = rng.uniform(0, [500, 250], (40, 2))
    sides = np.exp(rng.uniform(np.log(8), np.log(140), (40, 2)))
    truth = torch.from_numpy(np.concatenate([low, low + sides], axis=1)).float()
    for k in range(40):
        cell, _ = assign_targets(centres, stride[:, 0], truth[k : k + 1])
        assert len(cell) >= 1
        offset = (centres[cell] - (truth[k, :2] + truth[k, 2:]) / 2).abs() / stride[cell]
        assert offset.max() <= 1.5


def test_loss_is_zero_for_perfect_and_large_for_wrong_predictions() -> None:
    from scan2sim.services.toolboxes.detector.network import assign_targets, cells, detection_losses

    size = (128, 192)
    centres, stride = cells(*size)
    box = torch.tensor([[40.0, 30.0, 90.0, 80.0, 1.0]])
    cell, _ = assign_targets(centres, stride[:, 0], box[:, :4])
    raw = torch.full((1, len(centres), 8), -20.0)
    raw[..., :4] = 0
    middle, sides = torch.tensor([65.0, 55.0]), torch.tensor([50.0, 50.0])
    raw[0, cell, :2] = (middle - centres[cell]) / stride[cell]
    raw[0, cell, 2:4] = torch.log(sides / stride[cell])
    raw[0, cell, 4] = raw[0, cell, 6] = 20.0
    none = torch.zeros(0, 4)
    good = detection_losses(raw, [box], [none], size)
    assert all(float(value) < 1e-3 for value in good.values())
    raw[0, :, 4] = 20.0
    assert float(detection_losses(raw, [box], [none], size)["objectness"]) > 1
    ignored = detection_losses(raw, [box], [torch.tensor([[0.0, 0.0, 192.0, 128.0]])], size)
    assert float(ignored["objectness"]) < 1e-3


def test_exported_onnx_matches_torch_for_any_batch_and_size(tmp_path: Path) -> None:
    from scan2sim.services.toolboxes.detector.export import export
    from scan2sim.services.toolboxes.detector.network import VehicleNet

    torch.manual_seed(0)
    network = VehicleNet(3).eval()
    export(network, tmp_path / "own.onnx", ["car", "van", "bus"], {"recipe": {"steps": 1}})
    session = onnxruntime.InferenceSession(tmp_path / "own.onnx", providers=["CPUExecutionProvider"])
    metadata = session.get_modelmeta().custom_metadata_map
    assert json.loads(metadata["names"]) == ["car", "van", "bus"]
    assert metadata["stride"] == "64" and metadata["license"]
    assert session.get_inputs()[0].name == "images" and session.get_outputs()[0].name == "output0"
    for shape in ((1, 3, 64, 64), (4, 3, 192, 128), (2, 3, 384, 640)):
        images = np.random.default_rng(0).random(shape, np.float32)
        with torch.inference_mode():
            want = network(torch.from_numpy(images)).numpy()
        (got,) = session.run(None, {"images": images})
        assert got.shape == (shape[0], sum(shape[2] * shape[3] // s**2 for s in (8, 16, 32, 64)), 8)
        np.testing.assert_allclose(got, want, atol=2e-3)


def small_dataset(folder: Path, seed: int = 0) -> Path:
    """Two photos of noise with a box each."""
    from scan2sim.pipeline.io.images import image

    (folder / "images").mkdir(parents=True)
    lines = []
    for i in range(2):
        rgb = np.random.default_rng([seed, i]).integers(0, 255, (96, 160, 3), np.uint8)
        image.write(folder / "images" / f"{i}.png", rgb)
        objects = [{"class": "car", "box": [30, 20, 110, 80], "visible": 1.0}]
        lines.append(json.dumps({"image": f"{i}.png", "objects": objects}) + "\n")
    (folder / "boxes.jsonl").write_text("".join(lines), encoding="utf-8")
    (folder / "classes.json").write_text('["car", "van"]', encoding="utf-8")
    return folder


def test_interrupted_training_resumes_with_the_same_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from scan2sim.services.toolboxes.detector import train

    monkeypatch.setattr(train, "CHECKPOINT_INTERVAL_S", 0.0)
    folders = [small_dataset(tmp_path / "a"), small_dataset(tmp_path / "b", 1)]
    settings = train.TrainingSettings(steps=4, crops=((64, 128),), pixels=16_384, seed=3)
    checkpoint = tmp_path / "vehicles.checkpoint"
    whole = train.train(folders, settings, train.OWN_WEIGHTS, checkpoint=checkpoint)
    assert not checkpoint.exists()

    def interrupt(fraction: float, message: str = "") -> None:
        if message.startswith("step 3"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train.train(folders, settings, train.OWN_WEIGHTS, interrupt, checkpoint)
    assert checkpoint.is_file()
    steps: list[str] = []
    resumed = train.train(
        folders,
        settings,
        train.OWN_WEIGHTS,
        lambda fraction, message="": steps.append(message.split(",")[0]),
        checkpoint,
    )
    assert steps[0] == "step 3"
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], value, msg=name)


def test_checkpoint_of_another_training_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from scan2sim.services.toolboxes.detector import train

    monkeypatch.setattr(train, "CHECKPOINT_INTERVAL_S", 0.0)
    folder, checkpoint = small_dataset(tmp_path / "a"), tmp_path / "vehicles.checkpoint"

    def interrupt(fraction: float, message: str = "") -> None:
        if message.startswith("step 2"):
            raise KeyboardInterrupt

    settings = train.TrainingSettings(steps=3, crops=((64, 64),), pixels=8192)
    with pytest.raises(KeyboardInterrupt):
        train.train([folder], settings, train.OWN_WEIGHTS, interrupt, checkpoint)
    steps: list[str] = []
    other = train.TrainingSettings(steps=3, crops=((64, 64),), pixels=8192, seed=1)
    train.train([folder], other, train.OWN_WEIGHTS, lambda fraction, message="": steps.append(message), checkpoint)
    assert steps[0].startswith("step 1")


def test_datasets_with_different_classes_are_rejected(tmp_path: Path) -> None:
    from scan2sim.services.toolboxes.detector import train

    folders = [small_dataset(tmp_path / "a"), small_dataset(tmp_path / "b")]
    (folders[1] / "classes.json").write_text('["car", "van", "bus"]', encoding="utf-8")
    with pytest.raises(DataError, match="same classes"):
        train.train(folders, train.TrainingSettings(steps=1))


def test_network_gives_the_same_boxes_for_a_mirrored_image() -> None:
    from scan2sim.services.toolboxes.detector.network import VehicleNet, cells

    torch.manual_seed(0)
    network = VehicleNet(2).eval()
    image = torch.rand(1, 3, 64, 128)
    with torch.inference_mode():
        plain, mirrored = network(image), network(image.flip(3))
    centres, _ = cells(64, 128)
    other = (
        torch.cdist(torch.stack([128 - centres[:, 0], centres[:, 1]], dim=1), centres).topk(4, largest=False).indices
    )
    stride = cells(64, 128)[1][:, 0]
    same = torch.stack([other[i][stride[other[i]] == stride[i]][0] for i in range(len(centres))])
    back = mirrored[:, same]
    back[..., 0] = 128 - back[..., 0]
    torch.testing.assert_close(back, plain, atol=1e-3, rtol=1e-3)


def test_threshold_for_a_precision_ignores_detections_in_ignored_regions() -> None:
    from scan2sim.services.toolboxes.detector.evaluate import at_precision

    corners = np.array([[0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10], [60, 0, 70, 10]], np.float32)
    ignored = np.array([[40, 0, 44, 12], [44, 0, 47, 12]], np.float32)
    truth = GroundTruth(np.concatenate([corners[:2], ignored]), np.zeros(4, np.int32), np.arange(4) >= 2)
    found = Predictions(corners, np.array([0.9, 0.6, 0.8, 0.5], np.float32), np.zeros(4, np.int32))
    figures = at_precision([found], [truth])
    assert (figures.recall, figures.precision, figures.vehicles) == (1, 1, 2)
    assert figures.threshold == pytest.approx(0.6)
    assert at_precision([found], [truth], 0.6).threshold == pytest.approx(0.5)


def test_average_precision_matches_a_manual_calculation() -> None:
    square = np.array([[0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10]], np.float32)
    truth = GroundTruth(square, np.zeros(3, np.int32), np.array([False, False, True]))
    away = square[:1] + np.float32(100)
    corners = np.concatenate([square[:1], away, square[1:2], square[2:]])
    found = Predictions(corners, np.array([0.9, 0.8, 0.7, 0.95], np.float32), np.zeros(4, np.int32))
    assert average_precision([found], [truth], 0) == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)
    twice = Predictions(np.repeat(square[:1], 2, axis=0), np.array([0.9, 0.8], np.float32), np.zeros(2, np.int32))
    assert average_precision([twice], [truth], 0) == pytest.approx(0.5)


def test_trained_network_detects_vehicles_in_unseen_images(dataset_folder: Path) -> None:
    session = onnxruntime.InferenceSession(OWN, providers=["CPUExecutionProvider"])
    names = json.loads(session.get_modelmeta().custom_metadata_map["names"])
    found, truth = [], []
    for one in dataset.read(dataset_folder)[0]:
        image, transform = yolo.letterbox(dataset.read_image(one.image), 640)
        got = yolo.decode(session.run(None, {"images": image[None]})[0][0], transform, 0.01)
        found.append(Predictions(got.corners, got.scores, got.labels))
        sides = (one.boxes[:, 2:] - one.boxes[:, :2]).max(axis=1, initial=0)
        ignored = (one.visible < 0.25) | (sides < 12)
        truth.append(GroundTruth(one.boxes, one.classes.astype(np.int32), ignored))
    assert average_precision(found, truth, names.index("car")) > 0.6
    assert average_precision(found, truth, names.index("train")) > 0.7
