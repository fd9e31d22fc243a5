"""Backend "street": the project's weights, other and invalid weights, and training."""

import json
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.types import U8

torch = pytest.importorskip("torch", reason="torch is not installed (pip install 'scan2sim[segmentation]')")
safetensors = pytest.importorskip("safetensors.torch", reason="safetensors is not installed")

from scan2sim.segmentation.backends import load  # noqa: E402
from scan2sim.segmentation.backends.street import DEFAULT_WEIGHTS, save  # noqa: E402
from scan2sim.segmentation.labels import CLASSES  # noqa: E402
from scan2sim.segmentation.network import StreetNet  # noqa: E402
from tests.conftest import ROOT  # noqa: E402


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "w.onnx"
    save(StreetNet(len(CLASSES)), path, {"iou": {}})
    return path.with_suffix(".safetensors")


def photos() -> Iterator[U8]:
    """Photos of the committed street, without and with lidar channels, and noise of an odd size."""
    import cv2

    yield np.random.default_rng(0).integers(0, 255, (101, 131, 7), np.uint8)
    for i, path in enumerate(sorted((ROOT / "data_samples" / "tile" / "photos").glob("*.jpg"))[:3]):
        rgb = cv2.imread(str(path))[..., ::-1]
        yield np.concatenate([rgb, np.full((*rgb.shape[:2], 4), 60 * i, np.uint8)], axis=2)


def test_default_weights_are_small_and_predict_every_class() -> None:
    network = load("street", None, "cpu")
    assert DEFAULT_WEIGHTS.stat().st_size < 8e6 and DEFAULT_WEIGHTS.with_suffix(".safetensors").stat().st_size < 8e6
    assert network.info.labels == CLASSES and len(network.info.sha256) == 64
    found = network.probabilities(np.random.default_rng(0).integers(0, 255, (96, 128, 7), np.uint8))
    assert found.shape == (len(CLASSES), 24, 32) and found.sum(axis=0) == pytest.approx(1, abs=1e-4)


def test_predictions_are_deterministic(weights: Path) -> None:
    photo = np.random.default_rng(0).integers(0, 255, (100, 130, 7), np.uint8)
    for form in (weights, weights.with_suffix(".onnx")):
        a, b = (load("street", form, "cpu").probabilities(photo) for _ in range(2))
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("own", [True, False], ids=["the project's own", "just trained"])
def test_onnxruntime_and_torch_predict_the_same_classes(weights: Path, own: bool) -> None:
    form = DEFAULT_WEIGHTS.with_suffix(".safetensors") if own else weights
    by_torch, by_onnx = load("street", form, "cpu"), load("street", form.with_suffix(".onnx"), "cpu")
    assert by_torch.info.labels == by_onnx.info.labels
    assert by_torch.info.pixels_per_radian == by_onnx.info.pixels_per_radian
    assert by_torch.info.channels and by_onnx.info.channels
    for photo in photos():
        a, b = by_torch.probabilities(photo), by_onnx.probabilities(photo)
        assert a.shape == b.shape and np.abs(a - b).max() < 1e-4
        assert (a.argmax(axis=0) == b.argmax(axis=0)).mean() > 0.9999


def test_classes_do_not_depend_on_the_number_of_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    photo = np.random.default_rng(0).integers(0, 255, (256, 320, 7), np.uint8)
    predicted = []
    for cores in ("1", "2", "3"):
        monkeypatch.setenv("OMP_NUM_THREADS", cores)
        predicted.append(load("street", None, "cpu").probabilities(photo))
    np.testing.assert_array_equal(predicted[0], predicted[1])
    np.testing.assert_array_equal(predicted[0], predicted[2])


def test_damaged_onnx_file_is_rejected(weights: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.onnx").write_bytes(DEFAULT_WEIGHTS.read_bytes()[:-1000])
    with pytest.raises(InputError, match=r"cut\.onnx"):
        load("street", tmp_path / "cut.onnx", "cpu")


def test_truncated_weights_are_rejected(weights: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.safetensors").write_bytes(weights.read_bytes()[:-1000])
    with pytest.raises(InputError, match=r"cut\.safetensors"):
        load("street", tmp_path / "cut.safetensors", "cpu")


def test_weights_of_another_network_are_rejected(tmp_path: Path) -> None:
    safetensors.save_file({"x": torch.zeros(3)}, tmp_path / "a.safetensors", {"network": "UNet", "labels": "[]"})
    with pytest.raises(InputError, match=r"UNet, not StreetNet"):
        load("street", tmp_path / "a.safetensors", "cpu")
    predicted = {"network": "StreetNet", "labels": json.dumps(CLASSES)}
    safetensors.save_file({"x": torch.zeros(3)}, tmp_path / "b.safetensors", predicted)
    with pytest.raises(InputError, match="weights are missing or unknown"):
        load("street", tmp_path / "b.safetensors", "cpu")


def test_pickle_is_rejected_and_not_run(tmp_path: Path) -> None:
    class Bad:
        def __reduce__(self) -> tuple[Any, ...]:
            return (open, (str(tmp_path / "harm"), "w"))

    (tmp_path / "w.pt").write_bytes(pickle.dumps(Bad()))
    with pytest.raises(InputError, match="safetensors"):
        load("street", tmp_path / "w.pt", "cpu")
    assert not (tmp_path / "harm").exists()


def colourful(folder: Path, n: int = 6) -> Path:
    """Folder of labelled photos in which the colour identifies the class."""
    import cv2

    rng = np.random.default_rng(0)
    for name in ("images", "labels"):
        (folder / name).mkdir(parents=True)
    for i in range(n):
        codes = np.zeros((128, 160), np.uint8)
        split = int(rng.integers(40, 120))
        codes[:, :split], codes[:, split:] = 11, 6
        rgb = np.where(codes[..., None] == 11, (90, 90, 90), (200, 120, 60)).astype(np.uint8)
        cv2.imwrite(str(folder / "images" / f"{i:03d}_0.png"), rgb[..., ::-1])
        cv2.imwrite(str(folder / "labels" / f"{i:03d}_0.png"), codes)
    return folder


@pytest.mark.slow
def test_training_learns_and_is_reproducible(tmp_path: Path) -> None:
    from scan2sim.segmentation.training.train import TrainingSettings, train

    folder = colourful(tmp_path / "set")
    settings = TrainingSettings(steps=60, batch=4, crop=(64, 96), held_out=0.2, rate=5e-3)
    first = train(folder, settings)
    assert first.iou["road"] > 0.6 and first.iou["building"] > 0.6
    again = train(folder, settings)
    for a, b in zip(first.network.state_dict().values(), again.network.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def test_training_continues_from_weights_without_lidar_channels(tmp_path: Path, weights: Path) -> None:
    from scan2sim.segmentation.training.train import TrainingSettings, train

    state = safetensors.load_file(weights)
    state["stem.0.weight"] = state["stem.0.weight"][:, :3].contiguous()
    safetensors.save_file(state, tmp_path / "old.safetensors")
    folder = colourful(tmp_path / "set", 2)
    settings = TrainingSettings(steps=1, batch=2, crop=(64, 96), rate=0.0, start=tmp_path / "old.safetensors")
    first = train(folder, settings).network.state_dict()["stem.0.weight"]
    assert torch.allclose(first[:, :3], state["stem.0.weight"].float()) and not first[:, 3:].any()


def test_folder_without_labels_is_rejected(tmp_path: Path) -> None:
    from scan2sim.segmentation.training.train import TrainingSettings, train

    with pytest.raises(DataError, match="images"):
        train(tmp_path, TrainingSettings(steps=1))
