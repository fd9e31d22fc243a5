"""The project's own detector: its losses, its file, and what the trained one finds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scan2sim.data_samples import boxes
from scan2sim.services.toolboxes import yolo
from scan2sim.services.toolboxes.detector import dataset
from scan2sim.services.toolboxes.detector.metrics import Found, Truth, average_precision
from tests.conftest import ROOT

onnxruntime = pytest.importorskip("onnxruntime")
torch = pytest.importorskip("torch")

OWN = ROOT / "services" / "toolboxes" / "weights" / "vehicles.onnx"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures of a crossing and a street that the network has not seen."""
    out = tmp_path_factory.mktemp("boxes")
    for _ in boxes.write(out, 60, 500, processes=1):
        pass
    return out


def test_pictures_come_with_boxes_and_go_on_where_they_ended(made: Path) -> None:
    found, names = dataset.read(made)
    before = (made / "boxes.jsonl").read_text(encoding="utf-8")
    for _ in boxes.write(made, 60, 500, processes=1):
        pass
    assert (made / "boxes.jsonl").read_text(encoding="utf-8") == before
    assert {"car", "train"} <= {names[int(k)] for one in found for k in one.classes}
    rng = np.random.default_rng(0)
    for one in found[::7]:
        image, things, left_alone = dataset.seen(one, (256, 320), rng)
        assert image.shape == (256, 320, 3) and image.min() >= 0 and image.max() <= 1
        for corners in (things[:, :4], left_alone):
            assert (corners >= 0).all() and (corners <= [320, 256, 320, 256]).all()
            assert (corners[:, 2:] > corners[:, :2]).all()


def test_boxes_move_with_the_picture(tmp_path: Path) -> None:
    import cv2

    rgb = np.full((384, 640, 3), 20, np.uint8)
    rgb[100:180, 300:420] = 255
    cv2.imwrite(str(tmp_path / "a.png"), rgb)
    box = np.array([[300, 100, 420, 180]], np.float32)
    one = dataset.Labelled(tmp_path / "a.png", box, np.zeros(1, np.float32), np.ones(1, np.float32))
    seen = 0
    for seed in range(20):
        image, things, _ = dataset.seen(one, (320, 384), np.random.default_rng(seed))
        if not len(things):
            continue
        x0, y0, x1, y1 = np.round(things[0, :4]).astype(int)
        grey = image.mean(axis=2)
        inner = grey[y0 + 2 : y1 - 2, x0 + 2 : x1 - 2].mean()
        rim = [grey[max(y0 - 8, 0) : max(y0 - 4, 0), x0:x1], grey[y0:y1, max(x0 - 8, 0) : max(x0 - 4, 0)]]
        around = [r.mean() for r in rim if r.size]
        seen += bool(around)
        assert all(inner > a for a in around), seed
    assert seen > 8


def test_each_box_is_found_by_places_near_its_middle() -> None:
    from scan2sim.services.toolboxes.detector.network import assigned, grid

    at, stride = grid(384, 640)
    rng = np.random.default_rng(3)
    low = rng.uniform(0, [500, 250], (40, 2))
    sides = np.exp(rng.uniform(np.log(8), np.log(140), (40, 2)))
    truth = torch.from_numpy(np.concatenate([low, low + sides], axis=1)).float()
    for k in range(40):
        place, _ = assigned(at, stride[:, 0], truth[k : k + 1])
        assert len(place) >= 1
        off = (at[place] - (truth[k, :2] + truth[k, 2:]) / 2).abs() / stride[place]
        assert off.max() <= 1.5


def test_perfect_answers_cost_nothing_and_bad_ones_much() -> None:
    from scan2sim.services.toolboxes.detector.network import assigned, grid, weighed

    size = (128, 192)
    at, stride = grid(*size)
    box = torch.tensor([[40.0, 30.0, 90.0, 80.0, 1.0]])
    place, _ = assigned(at, stride[:, 0], box[:, :4])
    raw = torch.full((1, len(at), 8), -20.0)
    raw[..., :4] = 0
    middle, sides = torch.tensor([65.0, 55.0]), torch.tensor([50.0, 50.0])
    raw[0, place, :2] = (middle - at[place]) / stride[place]
    raw[0, place, 2:4] = torch.log(sides / stride[place])
    raw[0, place, 4] = raw[0, place, 6] = 20.0
    none = torch.zeros(0, 4)
    good = weighed(raw, [box], [none], size)
    assert all(float(value) < 1e-3 for value in good.values())
    raw[0, :, 4] = 20.0
    assert float(weighed(raw, [box], [none], size)["there"]) > 1
    spared = weighed(raw, [box], [torch.tensor([[0.0, 0.0, 192.0, 128.0]])], size)
    assert float(spared["there"]) < 1e-3


def test_the_file_says_what_torch_says_for_any_batch_and_size(tmp_path: Path) -> None:
    from scan2sim.services.toolboxes.detector.export import export
    from scan2sim.services.toolboxes.detector.network import VehicleNet

    torch.manual_seed(0)
    network = VehicleNet(3).eval()
    export(network, tmp_path / "own.onnx", ["car", "van", "bus"], {"recipe": {"steps": 1}})
    session = onnxruntime.InferenceSession(tmp_path / "own.onnx", providers=["CPUExecutionProvider"])
    told = session.get_modelmeta().custom_metadata_map
    assert json.loads(told["names"]) == ["car", "van", "bus"] and told["stride"] == "64" and told["license"]
    assert session.get_inputs()[0].name == "images" and session.get_outputs()[0].name == "output0"
    for shape in ((1, 3, 64, 64), (4, 3, 192, 128), (2, 3, 384, 640)):
        images = np.random.default_rng(0).random(shape, np.float32)
        with torch.inference_mode():
            want = network(torch.from_numpy(images)).numpy()
        (got,) = session.run(None, {"images": images})
        assert got.shape == (shape[0], sum(shape[2] * shape[3] // s**2 for s in (8, 16, 32, 64)), 8)
        np.testing.assert_allclose(got, want, atol=2e-3)


def test_average_precision_is_what_it_is_by_hand() -> None:
    square = np.array([[0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10]], np.float32)
    truth = Truth(square, np.zeros(3, np.int32), np.array([False, False, True]))
    away = square[:1] + np.float32(100)
    corners = np.concatenate([square[:1], away, square[1:2], square[2:]])
    found = Found(corners, np.array([0.9, 0.8, 0.7, 0.95], np.float32), np.zeros(4, np.int32))
    assert average_precision([found], [truth], 0) == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)
    twice = Found(np.repeat(square[:1], 2, axis=0), np.array([0.9, 0.8], np.float32), np.zeros(2, np.int32))
    assert average_precision([twice], [truth], 0) == pytest.approx(0.5)


def test_the_trained_network_finds_vehicles_it_has_never_seen(made: Path) -> None:
    session = onnxruntime.InferenceSession(OWN, providers=["CPUExecutionProvider"])
    names = json.loads(session.get_modelmeta().custom_metadata_map["names"])
    found, truth = [], []
    for one in dataset.read(made)[0]:
        image, transform = yolo.letterbox(dataset.picture(one.image), 640)
        got = yolo.decode(session.run(None, {"images": image[None]})[0][0], transform, 0.01)
        found.append(Found(got.corners, got.scores, got.labels))
        sides = (one.boxes[:, 2:] - one.boxes[:, :2]).max(axis=1, initial=0)
        truth.append(Truth(one.boxes, one.classes.astype(np.int32), (one.visible < 0.25) | (sides < 12)))
    assert average_precision(found, truth, names.index("car")) > 0.6
    assert average_precision(found, truth, names.index("train")) > 0.7
