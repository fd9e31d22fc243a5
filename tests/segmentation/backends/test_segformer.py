"""Backend "segformer": predictions compared with `transformers`, and rejection of invalid files."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.segmentation.backends import load
from scan2sim.segmentation.labels import CLASSES, map_labels

torch = pytest.importorskip("torch", reason="SegFormer runs on torch")
transformers = pytest.importorskip("transformers", reason="SegFormer is transformers'")

CITYSCAPES = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation", "terrain",
    "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle",
)  # fmt: skip
NVIDIA = "NVIDIA's SegFormer weights are for non-commercial use"


def tiny() -> Any:
    """A random SegFormer whose normalisation statistics are not the defaults, so that missing weights are detected."""
    torch.manual_seed(3)
    config = transformers.SegformerConfig(
        depths=[1, 2, 1, 1], hidden_sizes=[8, 16, 16, 32], num_attention_heads=[1, 1, 2, 2], decoder_hidden_size=24,
        id2label=dict(enumerate(CITYSCAPES)),
    )  # fmt: skip
    net = transformers.SegformerForSemanticSegmentation(config).eval()
    with torch.no_grad():
        for value in net.state_dict().values():
            if value.is_floating_point():
                value.add_(torch.rand_like(value) * 0.2)
    return net


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder written by `save_pretrained`."""
    tiny().save_pretrained(tmp_path / "tiny-b0")
    return tmp_path / "tiny-b0"


def photo(height: int = 70, width: int = 101) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)


def reference(rgb: np.ndarray, mean: Any = (0.485, 0.456, 0.406), std: Any = (0.229, 0.224, 0.225)) -> np.ndarray:
    x = ((rgb / 255 - np.array(mean)) / np.array(std)).astype(np.float32)
    with torch.no_grad():
        logits = tiny()(torch.from_numpy(x.transpose(2, 0, 1)[None].copy())).logits
    return np.asarray(torch.softmax(logits, 1)[0].numpy())


def change(file: Path, **changes: object) -> None:
    config = json.loads(file.read_text(encoding="utf-8"))
    file.write_text(
        json.dumps({key: value for key, value in {**config, **changes}.items() if value is not None}), encoding="utf-8"
    )


def error_of(path: Path) -> InputError:
    """The error raised for an invalid file; it has a remedy and is one line."""
    with pytest.raises(InputError) as caught:
        load("segformer", path, "cpu")
    assert caught.value.remedy and "\n" not in str(caught.value)
    return caught.value


def test_probabilities_equal_transformers(folder: Path) -> None:
    network = load("segformer", folder, "cpu")
    found = network.probabilities(photo())
    assert found.dtype == np.float32 and found.shape == (19, 18, 26)
    assert np.allclose(found.sum(axis=0), 1, atol=1e-5)
    assert np.abs(found - reference(photo())).max() < 1e-4
    assert np.ptp(found, axis=(1, 2)).max() > 0.01, "the output should depend on the photo"
    info = network.info
    assert info.labels == CITYSCAPES and info.name == "segformer (tiny-b0)" and info.pixels_per_radian is None
    assert info.sha256 == hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    index = map_labels(info.labels, str(folder))
    assert CLASSES[index[0]] == "road" and CLASSES[index[13]] == "vehicle" and CLASSES[index[10]] == "sky"


def test_weights_of_old_and_new_transformers_are_read(folder: Path, tmp_path: Path) -> None:
    from safetensors.torch import load_file

    old, new = load_file(folder / "model.safetensors"), tiny().state_dict()
    assert (
        "segformer.encoder.block.1.0.attention.self.query.weight" in old and "decode_head.linear_c.0.proj.bias" in old
    )
    assert not set(old) & {name for name in new if name.startswith("segformer.")}
    for name, state in (("old", old), ("new", new)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_bytes((folder / "config.json").read_bytes())
        torch.save(state, tmp_path / name / "pytorch_model.bin")
        found = load("segformer", tmp_path / name, "cpu").probabilities(photo())
        assert np.abs(found - reference(photo())).max() < 1e-4


@pytest.mark.parametrize("kind", ["safetensors", "zip", "old pickle", "half precision"])
def test_single_file_next_to_its_config_is_loaded(folder: Path, kind: str) -> None:
    file = folder / "model.safetensors"
    if kind != "safetensors":
        file.unlink()
        file = folder / "best.pth"
        state = tiny().state_dict()
        if kind == "half precision":
            state = {name: value.half() if value.is_floating_point() else value for name, value in state.items()}
        torch.save(state, file, _use_new_zipfile_serialization=kind != "old pickle")
    network = load("segformer", file, "cpu")
    tolerance = 0.02 if kind == "half precision" else 1e-4
    assert np.abs(network.probabilities(photo()) - reference(photo())).max() < tolerance
    assert network.info.name == f"segformer ({file.name})"


def test_photos_are_normalised_by_the_preprocessor_config(folder: Path) -> None:
    config = {"image_mean": [0.5, 0.4, 0.3], "image_std": [0.2, 0.3, 0.4], "do_normalize": True}
    (folder / "preprocessor_config.json").write_text(json.dumps(config), encoding="utf-8")
    found = load("segformer", folder, "cpu").probabilities(photo())
    assert np.abs(found - reference(photo(), config["image_mean"], config["image_std"])).max() < 1e-4
    change(folder / "preprocessor_config.json", do_normalize=False)
    found = load("segformer", folder, "cpu").probabilities(photo())
    assert np.abs(found - reference(photo(), (0, 0, 0), (1, 1, 1))).max() < 1e-4
    for wrong in ([0.5, 0.4], "grey", [1, 1, 0], None):
        (folder / "preprocessor_config.json").write_text(json.dumps({"image_std": wrong}), encoding="utf-8")
        assert error_of(folder).where.endswith("preprocessor_config.json")


def test_narrow_photos_are_classified(folder: Path) -> None:
    assert load("segformer", folder, "cpu").probabilities(photo(9, 64)).shape == (19, 8, 16)


@pytest.mark.parametrize(
    ("readme", "licence"),
    [
        (None, f"not stated; {NVIDIA}"),
        ("---\nlicense: other\ntags: [vision]\n---\n# B0\n", f"other; {NVIDIA}"),
        ("---\ntags:\n- vision\nlicense: 'apache-2.0'\n---\n", "apache-2.0"),
        ("---\nlicense: other\nlicense_name: our-own\n---\n", "other, our-own"),
        ("# B0\nlicense: mit\n", f"not stated; {NVIDIA}"),
    ],
)
def test_licence_is_read_from_the_readme(folder: Path, readme: str | None, licence: str) -> None:
    if readme:
        (folder / "README.md").write_text(readme, encoding="utf-8")
    assert load("segformer", folder, "cpu").info.licence == licence


def test_missing_weights_are_rejected(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"label\.weights"):
        load("segformer", None, "cpu")
    assert "nothing is downloaded" in error_of(Path("nvidia/segformer-b0-finetuned-cityscapes-1024-1024")).remedy
    (tmp_path / "empty").mkdir()
    assert "no model.safetensors" in error_of(tmp_path / "empty").cause
    (folder / "config.json").unlink()
    assert error_of(folder).where == str(folder / "config.json")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
@pytest.mark.parametrize("name", ["model.safetensors", "pytorch_model.bin", "old.bin"])
def test_truncated_file_is_rejected(folder: Path, name: str, share: float) -> None:
    if name != "model.safetensors":
        (folder / "model.safetensors").unlink()
        torch.save(tiny().state_dict(), folder / name, _use_new_zipfile_serialization=name != "old.bin")
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(whole[: int(len(whole) * share)])
    error = error_of(folder / name)
    assert error.where == str(folder / name) and "tensors" in error.cause


class Trap:
    """Creates a folder when it is unpickled."""

    def __init__(self, made: Path) -> None:
        self.made = made

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.made),)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("file_format", ["torch", "old torch", "pickle", "new pickle"])
def test_code_in_a_pickle_is_not_run(folder: Path, tmp_path: Path, file_format: str) -> None:
    file, made = folder / "pytorch_model.bin", tmp_path / "made"
    (folder / "model.safetensors").unlink()
    content = {**tiny().state_dict(), "trap": Trap(made)}
    if file_format.endswith("pickle"):
        file.write_bytes(pickle.dumps({"trap": Trap(made)}, 2 if file_format == "pickle" else 4))
    else:
        torch.save(content, file, _use_new_zipfile_serialization=file_format == "torch")
    error = error_of(folder)
    assert not made.exists()
    assert error.where == str(file) and "safetensors" in error.remedy
    code = "contains code or objects besides tensors; not run (posix.mkdir)"
    assert ("only tensors" if file_format == "new pickle" else code) in error.cause
    if file_format == "torch":  # the trap works if it is loaded unsafely
        torch.load(file, weights_only=False)
        assert made.exists()


@pytest.mark.parametrize("content", [{"epoch": 3}, [1, 2], {"state_dict": {"a": 1}}])
def test_pickle_of_other_objects_is_rejected(folder: Path, content: object) -> None:
    torch.save(content, folder / "other.bin")
    assert "not a dictionary of tensors" in error_of(folder / "other.bin").cause


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"architectures": ["BeitForSemanticSegmentation"], "model_type": "beit"}, "BeitForSemanticSegmentation"),
        ({"architectures": ["SegformerForImageClassification"]}, "SegformerForImageClassification"),
        ({"architectures": None, "model_type": "beit"}, "beit"),
        ({"architectures": None, "model_type": None}, "another network"),
    ],
)
def test_another_architecture_is_rejected(folder: Path, changes: dict[str, object], expected: str) -> None:
    change(folder / "config.json", **changes)
    error = error_of(folder)
    assert error.where == str(folder / "config.json")
    assert expected in error.cause and "SegformerForSemanticSegmentation" in error.cause


@pytest.mark.parametrize("text", ["", "{", "[1]", '"segformer"'])
def test_invalid_config_is_rejected(folder: Path, text: str) -> None:
    (folder / "config.json").write_text(text, encoding="utf-8")
    assert error_of(folder).where == str(folder / "config.json")


@pytest.mark.parametrize("labels", [None, {}, ["road"], {"0": "road", "2": "sky"}, {"a": "road"}])
def test_every_channel_needs_a_label(folder: Path, labels: object) -> None:
    change(folder / "config.json", id2label=labels)
    error = error_of(folder)
    assert error.where == str(folder / "config.json") and "id2label" in error.cause


@pytest.mark.parametrize(
    "changes",
    [
        {"hidden_sizes": [8, 16, 16, 64]},
        {"depths": [1, 1, 1, 1]},
        {"depths": [2, 2, 2, 2]},
        {"depths": [1]},
        {"depths": "many"},
        {"num_attention_heads": [3, 3, 3, 3]},
        {"hidden_act": "none such"},
        {"num_channels": 4},
        {"id2label": {"0": "road", "1": "sky"}},
    ],
)
def test_weights_of_another_shape_are_rejected(folder: Path, changes: dict[str, object]) -> None:
    change(folder / "config.json", **changes)
    error = error_of(folder)
    assert error.where == str(folder / "model.safetensors") and "doesn't match" in error.cause


def test_config_cannot_load_remote_code(folder: Path) -> None:
    change(
        folder / "config.json", attn_implementation="someone/kernel", _attn_implementation="someone/kernel",
        auto_map={"AutoModel": "someone/code--net.Net"}, quantization_config={"quant_method": "someone"},
        reshape_last_stage=False, dtype="float16",
    )  # fmt: skip
    found = load("segformer", folder, "cpu").probabilities(photo())
    assert np.abs(found - reference(photo())).max() < 1e-4


def test_no_network_connection_is_made(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import socket

    def connect(*_: object) -> None:
        raise AssertionError("a network connection was attempted")

    monkeypatch.setattr(socket.socket, "connect", connect)
    monkeypatch.setattr(socket, "getaddrinfo", connect)
    load("segformer", folder, "cpu")
    error_of(Path("nvidia/segformer-b0-finetuned-cityscapes-1024-1024"))


def test_insufficient_gpu_memory_raises_memory_error(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory")

    network = load("segformer", folder, "cpu")
    monkeypatch.setattr(transformers.SegformerForSemanticSegmentation, "forward", full)
    with pytest.raises(MemoryError, match="out of memory"):
        network.probabilities(photo())
