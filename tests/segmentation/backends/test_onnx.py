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
    size: tuple[Any, ...] = ("h", "w"),
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


def logits(rgb: np.ndarray, mean: np.ndarray = MEAN, std: np.ndarray = STD) -> np.ndarray:
    x = (rgb.astype(np.float32) / 255 - mean) / std
    blocks = x.reshape(rgb.shape[0] // 2, 2, rgb.shape[1] // 2, 2, 3)
    return np.asarray(np.einsum("yaxbc,kcab->kyx", blocks, WEIGHTS))


def reference(rgb: np.ndarray, mean: np.ndarray = MEAN, std: np.ndarray = STD) -> np.ndarray:
    x = logits(rgb, mean, std)
    powers = np.exp(x - x.max(axis=0))
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
    (tmp_path / "net.labels.txt").write_text("\ufeffroad\r\nbuilding\r\nsky \ncar\n\n", "utf-8")
    assert load("onnx", path, "cpu").info.labels == tuple(LABELS)
    (tmp_path / "net.labels.txt").write_text("road\n\nbuilding\nsky\ncar\n", "utf-8")  # would shift all that follow
    assert "void for one without a meaning" in error_of(path).remedy
    (tmp_path / "net.labels.txt").write_bytes(b"\xff\xfe\x80")
    assert error_of(path).where == str(tmp_path / "net.labels.txt")
    (tmp_path / "net.labels.txt").write_text("", encoding="utf-8")
    assert "line 1 is empty" in error_of(path).cause
    (tmp_path / "net.labels.txt").write_text("road\nsky\n", encoding="utf-8")
    assert "for 2 labels" in error_of(path).cause
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


def graph(path: Path, nodes: list[Any], takes: list[Any], gives: dict[str, tuple[int, list[Any]]]) -> Path:
    """Write a network of `WEIGHTS`, an input (type, shape) named "image", and outputs (type, shape) by name."""
    from onnx import helper, numpy_helper

    values = [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in gives.items()]
    constants = [numpy_helper.from_array(WEIGHTS, "weights")]
    net = helper.make_graph(nodes, "net", [helper.make_tensor_value_info("image", *takes)], values, constants)
    model = helper.make_model(net, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {"labels": json.dumps(LABELS)})
    onnx.save(model, path)
    return path


def conv(source: str = "image", result: str = "logits") -> Any:
    return onnx.helper.make_node("Conv", [source, "weights"], [result], strides=[2, 2])


IMAGE: list[Any] = [1, [1, 3, "h", "w"]]
SCORES: tuple[int, list[Any]] = (1, [1, 4, "a", "b"])


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ({"inputs": 2}, "2 inputs (image, more0), not one"),
        ({"channels": 4}, "unsupported input: tensor(float) of shape [1, 4, 'h', 'w']"),
    ],
)
def test_unsupported_networks_are_rejected(tmp_path: Path, how: dict[str, Any], expected: str) -> None:
    error = error_of(write(tmp_path / "net.onnx", **how))
    assert error.where == str(tmp_path / "net.onnx") and expected in error.cause


@pytest.mark.parametrize(
    ("node", "takes", "gives", "expected"),
    [
        ("Flatten", IMAGE, [1, "n"], "unsupported outputs: out [1, 'n']"),
        ("Squeeze", [1, [1, 3, "h"]], [3, "h"], "unsupported input: tensor(float) of shape [1, 3, 'h']"),
        ("Identity", [11, [1, 3, "h", "w"]], [1, 3, "h", "w"], "unsupported input: tensor(double)"),
        ("Identity", [1, [4, 3, "h", "w"]], [4, 3, "h", "w"], "unsupported input: tensor(float) of shape [4, 3"),
    ],
)
def test_unsupported_types_and_shapes_are_rejected(
    tmp_path: Path, node: str, takes: list[Any], gives: list[Any], expected: str
) -> None:
    nodes = [onnx.helper.make_node(node, ["image"], ["out"])]
    assert expected in error_of(graph(tmp_path / "net.onnx", nodes, takes, {"out": (takes[0], gives)})).cause


def test_outputs_of_an_instance_segmentation_are_rejected(tmp_path: Path) -> None:
    nodes = [conv(result="output0"), conv(result="output1")]
    path = graph(tmp_path / "yolo11m-seg.onnx", nodes, IMAGE, {"output0": SCORES, "output1": SCORES})
    assert "unsupported outputs: output0 [1, 4, 'a', 'b'], output1" in error_of(path).cause
    assert "name it out or logits" in error_of(path).remedy


@pytest.mark.parametrize(("main", "other"), [("out", "aux"), ("logits", "hidden_states.0")])
def test_scores_among_other_outputs_are_found_by_their_name(tmp_path: Path, main: str, other: str) -> None:
    nodes = [conv(result=main), onnx.helper.make_node("Neg", [main], [other])]
    path = graph(tmp_path / "deeplab.onnx", nodes, IMAGE, {other: SCORES, main: SCORES})
    assert np.abs(load("onnx", path, "cpu").probabilities(photo()) - reference(photo())).max() < 1e-4


@pytest.mark.parametrize(
    ("axis", "keep", "kind"),
    [(1, 1, 7), (1, 0, 6), (3, 1, 6), (1, 1, 2)],
    ids=["mmdeploy", "PaddleSeg", "TAO", "bytes"],
)
def test_indices_of_labels_are_read(tmp_path: Path, axis: int, keep: int, kind: int) -> None:
    nodes = [conv(), onnx.helper.make_node("Transpose", ["logits"], ["last"], perm=[0, 2, 3, 1])]
    source = "last" if axis == 3 else "logits"
    nodes += [onnx.helper.make_node("ArgMax", [source], ["best"], axis=axis, keepdims=keep)]
    nodes += [onnx.helper.make_node("Cast", ["best"], ["output"], to=kind)]
    shape: list[Any] = [1, "a", "b"]
    if keep:
        shape.insert(axis, 1)
    path = graph(tmp_path / "argmax.onnx", nodes, IMAGE, {"output": (kind, shape)})
    found = load("onnx", path, "cpu").probabilities(photo())
    assert found.dtype == np.float32 and (found.sum(axis=0) == 1).all()
    assert (found.argmax(axis=0) == reference(photo()).argmax(axis=0)).all()


def test_integers_for_each_label_are_no_indices(tmp_path: Path) -> None:
    """A quantized softmax, whose values aren't scaled back."""
    nodes = [conv(), onnx.helper.make_node("Softmax", ["logits"], ["shares"], axis=1)]
    nodes += [onnx.helper.make_node("Cast", ["shares"], ["output"], to=2)]
    network = load("onnx", graph(tmp_path / "n.onnx", nodes, IMAGE, {"output": (2, [1, 4, "a", "b"])}), "cpu")
    with pytest.raises(InputError, match=r"output of uint8 \(1, 4, 16, 24\)"):
        network.probabilities(photo())


@pytest.mark.parametrize(("shift", "fits"), [(0, True), (252, True), (2, False)])
def test_indices_without_a_label_are_rejected_unless_they_are_255(tmp_path: Path, shift: int, fits: bool) -> None:
    nodes = [conv(), onnx.helper.make_node("ArgMax", ["logits"], ["best"], axis=1, keepdims=0)]
    constant = onnx.numpy_helper.from_array(np.array(shift), "shift")
    nodes += [onnx.helper.make_node("Constant", [], ["shift"], value=constant)]
    three = onnx.numpy_helper.from_array(np.array(3), "three")
    nodes += [onnx.helper.make_node("Constant", [], ["three"], value=three)]
    nodes += [onnx.helper.make_node("Equal", ["best", "three"], ["last"])]  # label 3 becomes 3 + shift
    nodes += [
        onnx.helper.make_node("Cast", ["last"], ["one"], to=7),
        onnx.helper.make_node("Mul", ["one", "shift"], ["more"]),
    ]
    nodes += [onnx.helper.make_node("Add", ["best", "more"], ["output"])]
    network = load("onnx", graph(tmp_path / "n.onnx", nodes, IMAGE, {"output": (7, [1, "a", "b"])}), "cpu")
    best = reference(photo()).argmax(axis=0)
    assert (best == 3).any()
    if not fits:
        with pytest.raises(InputError, match="up to 5 for 4 labels"):
            network.probabilities(photo())
        return
    found = network.probabilities(photo())
    assert (found.argmax(axis=0)[best < 3] == best[best < 3]).all()
    assert (found[:, best == 3].sum(axis=0) == (shift == 0)).all()


def test_bytes_with_channels_last_are_grey_levels(tmp_path: Path) -> None:
    nodes = [
        onnx.helper.make_node("Cast", ["image"], ["float"], to=1),
        onnx.helper.make_node("Transpose", ["float"], ["first"], perm=[0, 3, 1, 2]),
        conv("first"),
        onnx.helper.make_node("Transpose", ["logits"], ["softmax"], perm=[0, 2, 3, 1]),
    ]
    path = graph(tmp_path / "tf.onnx", nodes, [2, [1, "h", "w", 3]], {"softmax": (1, [1, "a", "b", 4])})
    network = load("onnx", path, "cpu")
    expected = reference(photo(), np.zeros(3, np.float32), np.full(3, 1 / 255, np.float32))
    assert np.abs(network.probabilities(photo()) - expected).max() < 1e-4
    assert network.info.assumed == ""


def test_multi_label_scores_are_scaled(tmp_path: Path) -> None:
    nodes = [conv(), onnx.helper.make_node("Sigmoid", ["logits"], ["scores"])]
    found = load("onnx", graph(tmp_path / "n.onnx", nodes, IMAGE, {"scores": SCORES}), "cpu").probabilities(photo())
    scores = 1 / (1 + np.exp(-logits(photo())))
    assert np.abs(found - scores / scores.sum(axis=0)).max() < 1e-3


def test_masks_and_their_labels_are_combined(tmp_path: Path) -> None:
    """As `post_process_semantic_segmentation` of transformers: of three masks, one is of no object."""
    classes = np.log(np.array([[0.7, 0.1, 0.1, 0.0, 0.1], [0, 0, 0.5, 0.5, 0], [0.01, 0, 0, 0, 0.99]]) + 1e-9)
    query = onnx.numpy_helper.from_array(classes.astype(np.float32)[None], "classes")
    pick = onnx.numpy_helper.from_array(np.array([2, 0, 1]), "pick")
    nodes = [
        onnx.helper.make_node("Constant", [], ["class_queries_logits"], value=query),
        onnx.helper.make_node("Constant", [], ["pick"], value=pick),
        conv(),
        onnx.helper.make_node("Gather", ["logits", "pick"], ["masks_queries_logits"], axis=1),
    ]
    gives: dict[str, tuple[int, list[Any]]] = {
        "masks_queries_logits": (1, [1, 3, "a", "b"]),
        "class_queries_logits": (1, [1, 3, 5]),
    }
    network = load("onnx", graph(tmp_path / "mask2former.onnx", nodes, IMAGE, gives), "cpu")
    masks = 1 / (1 + np.exp(-logits(photo())))[[2, 0, 1]]
    expected = np.einsum("qc,qhw->chw", np.exp(classes)[:, :4], masks)
    assert np.abs(network.probabilities(photo()) - expected / expected.sum(axis=0)).max() < 1e-3


def test_files_of_hugging_face_beside_the_network_are_read(tmp_path: Path) -> None:
    """As Optimum writes them, and transformers.js with the network in a folder `onnx`."""
    config = {"id2label": {str(i): name for i, name in enumerate(LABELS)}}
    (tmp_path / "config.json").write_text(json.dumps(config), encoding="utf-8")
    (tmp_path / "onnx").mkdir()
    path = write(tmp_path / "onnx" / "model.onnx", labels=None)
    network = load("onnx", path, "cpu")
    assert network.info.labels == tuple(LABELS) and "was assumed" in network.info.assumed
    assert np.abs(network.probabilities(photo()) - reference(photo())).max() < 1e-4
    preprocessor = {"image_mean": [0.5, 0.4, 0.3], "image_std": [0.5, 0.5, 0.25], "do_normalize": True}
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(preprocessor), encoding="utf-8")
    network = load("onnx", path, "cpu")
    expected = reference(photo(), np.array([0.5, 0.4, 0.3], np.float32), np.array([0.5, 0.5, 0.25], np.float32))
    assert np.abs(network.probabilities(photo()) - expected).max() < 1e-4 and network.info.assumed == ""
    preprocessor = {"do_flip_channel_order": True, "do_rescale": False}  # blue, green, red, 0 to 255
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(preprocessor), encoding="utf-8")
    expected = reference(photo()[..., ::-1], np.zeros(3, np.float32), np.full(3, 1 / 255, np.float32))
    assert np.abs(load("onnx", path, "cpu").probabilities(photo()) - expected).max() < 1e-4
    (tmp_path / "config.json").write_text("{}", encoding="utf-8")
    assert "no labels found" in error_of(path).cause


def test_file_of_a_newer_opset_names_the_remedy(tmp_path: Path) -> None:
    path = write(tmp_path / "net.onnx")
    model = onnx.load(path)
    model.opset_import[0].version = 99
    onnx.save(model, path)
    assert "older opset" in error_of(path).remedy
    model.opset_import[0].version, model.ir_version = 17, 99
    onnx.save(model, path)
    assert "older opset" in error_of(path).remedy


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
