"""Backend "onnx": predictions compared with NumPy, and rejection of invalid files."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.segmentation.backends import load

pytest.importorskip("onnxruntime", reason="runs the networks")
onnx = pytest.importorskip("onnx", reason="makes the networks")

LABELS = ["road", "building", "sky", "car"]
WEIGHTS = np.random.default_rng(1).normal(0, 1, (4, 3, 2, 2)).astype(np.float32)
MEAN, STD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)


def write(
    path: Path,
    size: tuple[Any, Any] = ("h", "w"),
    *,
    softmax: bool = False,
    channels: int = 3,
    kind: int | None = None,
    inputs: int = 1,
    outputs: int = 1,
    out_shape: list[Any] | None = None,
    labels: object = LABELS,
    **meta: str,
) -> Path:
    """Write a network of one 2 x 2 convolution with stride 2 to four labels, optionally with a softmax."""
    from onnx import TensorProto, helper, numpy_helper

    kind = kind or TensorProto.FLOAT
    weights = WEIGHTS.astype(helper.tensor_dtype_to_np_dtype(kind))
    if channels != 3:
        weights = np.concatenate([weights] * channels, axis=1)[:, :channels]
    nodes = [helper.make_node("Conv", ["image", "weights"], ["logits"], strides=[2, 2])]
    nodes += [helper.make_node("Softmax", ["logits"], ["shares"], axis=1)] if softmax else []
    ends = (["shares"] if softmax else ["logits"]) + ["second"] * (outputs - 1)
    nodes += [helper.make_node("Identity", ["image"], ["second"])] if outputs > 1 else []
    takes = [helper.make_tensor_value_info("image", kind, [1, channels, *size])]
    takes += [helper.make_tensor_value_info(f"more{i}", kind, [1]) for i in range(inputs - 1)]
    gives = [helper.make_tensor_value_info(name, kind, out_shape or [1, 4, "a", "b"]) for name in ends]
    graph = helper.make_graph(nodes, "net", takes, gives, [numpy_helper.from_array(weights, "weights")])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    text = labels if isinstance(labels, str) else json.dumps(labels)
    metadata = {**({} if labels is None else {"labels": text}), **meta}
    helper.set_model_props(model, metadata)
    onnx.save(model, path)
    return path


def photo(height: int = 32, width: int = 48) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)


def reference(rgb: np.ndarray, mean: np.ndarray = MEAN, std: np.ndarray = STD) -> np.ndarray:
    x = (rgb.astype(np.float32) / 255 - mean) / std
    blocks = x.reshape(rgb.shape[0] // 2, 2, rgb.shape[1] // 2, 2, 3)
    powers = np.exp(np.einsum("yaxbc,kcab->kyx", blocks, WEIGHTS))
    return np.asarray(powers / powers.sum(axis=0))


def error_of(path: Path) -> InputError:
    """The error raised for an invalid file; it has a remedy and is one line."""
    with pytest.raises(InputError) as caught:
        load("onnx", path, "cpu")
    assert caught.value.remedy and "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("softmax", [False, True])
def test_probabilities_equal_numpys(tmp_path: Path, softmax: bool) -> None:
    path = write(tmp_path / "net.onnx", softmax=softmax, license="mit")
    network = load("onnx", path, "cpu")
    for size in ((32, 48), (64, 20)):
        found = network.probabilities(photo(*size))
        assert found.dtype == np.float32 and found.shape == (4, size[0] // 2, size[1] // 2)
        assert np.allclose(found.sum(axis=0), 1, atol=1e-5)
        assert np.abs(found - reference(photo(*size))).max() < 1e-4
    info = network.info
    assert info.labels == tuple(LABELS) and info.name == "onnx (net.onnx)" and info.licence == "mit"
    assert info.sha256 == hashlib.sha256(path.read_bytes()).hexdigest() and info.pixels_per_radian is None


def test_half_precision_is_supported(tmp_path: Path) -> None:
    path = write(tmp_path / "net.onnx", softmax=True, kind=onnx.TensorProto.FLOAT16)
    found = load("onnx", path, "cpu").probabilities(photo())
    assert np.abs(found - reference(photo())).max() < 0.02 and np.allclose(found.sum(axis=0), 1, atol=1e-5)


@pytest.mark.parametrize("size", [(16, 24), ("h", 24), (16, "w"), (64, 96)])
def test_photos_are_resized_to_a_fixed_input_size(tmp_path: Path, size: tuple[Any, Any]) -> None:
    import cv2

    network = load("onnx", write(tmp_path / "net.onnx", size), "cpu")
    height, width = (n if isinstance(n, int) else own for n, own in zip(size, (32, 48), strict=True))
    way = cv2.INTER_LINEAR if height > 32 else cv2.INTER_AREA
    expected = reference(cv2.resize(photo(), (width, height), interpolation=way))
    assert np.abs(network.probabilities(photo()) - expected).max() < 1e-4


def test_photos_are_normalised_by_the_metadata(tmp_path: Path) -> None:
    path = write(tmp_path / "net.onnx", mean="[0, 0.1, -0.2]", std="[1, 2, 0.5]")
    expected = reference(photo(), np.array([0, 0.1, -0.2], np.float32), np.array([1, 2, 0.5], np.float32))
    assert np.abs(load("onnx", path, "cpu").probabilities(photo()) - expected).max() < 1e-4
    wrongs: tuple[dict[str, Any], ...] = ({"std": "[1, 0, 1]"}, {"mean": "[1, 1]"}, {"mean": "grey"}, {"std": "null"})
    for wrong in wrongs:
        assert "for the normalisation of photos" in error_of(write(path, **wrong)).cause


def test_labels_are_read_from_a_text_file(tmp_path: Path) -> None:
    path = write(tmp_path / "net.onnx", labels=None)
    (tmp_path / "net.labels.txt").write_text("\ufeffroad\r\nbuilding\r\n\nsky \ncar\n", "utf-8")
    assert load("onnx", path, "cpu").info.labels == tuple(LABELS)
    (tmp_path / "net.labels.txt").write_bytes(b"\xff\xfe\x80")
    assert error_of(path).where == str(tmp_path / "net.labels.txt")
    for too_few in ("", "road\nsky\n"):
        (tmp_path / "net.labels.txt").write_text(too_few, encoding="utf-8")
        assert "label" in error_of(path).cause
    (tmp_path / "net.labels.txt").unlink()
    error = error_of(path)
    assert error.where == str(path) and "no labels found" in error.cause and "net.labels.txt" in error.remedy


@pytest.mark.parametrize("labels", [{"0": "road"}, "road, sky", '"road"', [1, 2, 3, 4], 4])
def test_invalid_labels_are_rejected(tmp_path: Path, labels: object) -> None:
    assert "not a list of names" in error_of(write(tmp_path / "net.onnx", labels=labels)).cause


def test_missing_weights_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"label\.weights"):
        load("onnx", None, "cpu")
    assert "file or folder not found" in error_of(tmp_path / "none.onnx").cause
    assert error_of(tmp_path).cause == "file not found"


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_truncated_file_is_rejected(tmp_path: Path, share: float) -> None:
    path = write(tmp_path / "net.onnx")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    error = error_of(path)
    assert error.where == str(path)


def test_external_weights_are_loaded_and_hashed(tmp_path: Path) -> None:
    path = write(tmp_path / "net.onnx")
    model = onnx.load(path)
    onnx.save(model, path, save_as_external_data=True, location="net.onnx.data", size_threshold=0)
    network = load("onnx", path, "cpu")
    assert np.abs(network.probabilities(photo()) - reference(photo())).max() < 1e-4
    both = path.read_bytes() + (tmp_path / "net.onnx.data").read_bytes()
    assert network.info.sha256 == hashlib.sha256(both).hexdigest()
    (tmp_path / "net.onnx.data").unlink()
    assert "can't be loaded" in error_of(path).cause


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ({"inputs": 2}, "2 inputs and 1 outputs (image, more0, logits)"),
        ({"outputs": 2, "out_shape": [1, "c", "a", "b"]}, "1 inputs and 2 outputs"),
        ({"channels": 4}, "unsupported input: tensor(float) of shape [1, 4, 'h', 'w']"),
        ({"labels": LABELS[:3]}, "4 output channels, but 3 labels"),
    ],
)
def test_unsupported_networks_are_rejected(tmp_path: Path, how: dict[str, Any], expected: str) -> None:
    error = error_of(write(tmp_path / "net.onnx", **how))
    assert error.where == str(tmp_path / "net.onnx") and expected in error.cause


@pytest.mark.parametrize(
    ("node", "takes", "gives", "expected"),
    [
        ("ArgMax", 1, 7, "unsupported output: tensor(int64) of shape [1, 1, 'h', 'w']"),
        ("Cast", 2, 1, "unsupported input: tensor(uint8) of shape [1, 3, 'h', 'w']"),
        ("Flatten", 1, 1, "unsupported output: tensor(float) of shape [1, "),
        ("Squeeze", 1, 1, "unsupported input: tensor(float) of shape [1, 3, 'h']"),
    ],
)
def test_unsupported_types_and_shapes_are_rejected(
    tmp_path: Path, node: str, takes: int, gives: int, expected: str
) -> None:
    from onnx import helper

    how: dict[str, Any] = {"Cast": {"to": 1}, "Squeeze": {}}.get(node, {"axis": 1})
    size = ["h"] if node == "Squeeze" else ["h", "w"]
    shapes: dict[str, list[Any]] = {"ArgMax": [1, 1, *size], "Flatten": [1, "n"], "Squeeze": [3, "h"]}
    graph = helper.make_graph(
        [helper.make_node(node, ["image"], ["out"], **how)],
        "net",
        [helper.make_tensor_value_info("image", takes, [1, 3, *size])],
        [helper.make_tensor_value_info("out", gives, shapes.get(node, [1, 3, *size]))],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, tmp_path / "net.onnx")
    assert expected in error_of(tmp_path / "net.onnx").cause


def test_failing_photo_size_is_reported(tmp_path: Path) -> None:
    network = load("onnx", write(tmp_path / "net.onnx"), "cpu")
    with pytest.raises(InputError, match="fails on a photo of 48 x 1"):
        network.probabilities(photo(1, 48))
    network.info = replace(network.info, labels=tuple(LABELS[:3]))  # as for a file without a static output shape
    with pytest.raises(InputError, match="for 3 labels"):
        network.probabilities(photo())


def test_missing_gpu_is_reported(tmp_path: Path) -> None:
    import onnxruntime

    if "CUDAExecutionProvider" in onnxruntime.get_available_providers():
        pytest.skip("onnxruntime has a GPU here")
    path = write(tmp_path / "net.onnx")
    with pytest.raises(SettingError, match=r"label\.device"):
        load("onnx", path, "cuda")
    assert load("onnx", path, "auto").probabilities(photo()).shape == (4, 16, 24)


def test_insufficient_memory_raises_memory_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def run(self, *_: object) -> None:
            raise RuntimeError("BFCArena: Failed to allocate memory for requested buffer of size 99999999")

    network = load("onnx", write(tmp_path / "net.onnx"), "cpu")
    monkeypatch.setattr(network, "_session", Full())
    with pytest.raises(MemoryError, match="Failed to allocate"):
        network.probabilities(photo())
