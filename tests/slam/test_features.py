"""Features, matchers and weights: requirements on all backends, files and folders of weights, invalid files."""

from __future__ import annotations

import hashlib
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.optional_deps import missing
from scan2sim.slam import features, matchers, weights
from scan2sim.slam.features import FeatureSet

SIZE = (240, 320)
PUBLISHED_WEIGHTS = {"aliked": "aliked/aliked-t16.pth", "superpoint": "superpoint/superpoint_v1.pth"}
"""Files of networks' weights, in the folder `weights` of the real data."""
SUPERPOINT_LAYERS = {
    "conv1a": (64, 1, 3, 3), "conv1b": (64, 64, 3, 3),
    "conv2a": (64, 64, 3, 3), "conv2b": (64, 64, 3, 3),
    "conv3a": (128, 64, 3, 3), "conv3b": (128, 128, 3, 3),
    "conv4a": (128, 128, 3, 3), "conv4b": (128, 128, 3, 3),
    "convPa": (256, 128, 3, 3), "convPb": (65, 256, 1, 1),
    "convDa": (256, 128, 3, 3), "convDb": (256, 256, 1, 1),
}  # fmt: skip
SUPERPOINT: dict[str, weights.Shape] = {f"{layer}.weight": shape for layer, shape in SUPERPOINT_LAYERS.items()} | {
    f"{layer}.bias": shape[:1] for layer, shape in SUPERPOINT_LAYERS.items()
}
"""Shapes of the tensors in superpoint_v1.pth."""


@pytest.fixture(autouse=True)
def one_thread_and_seed() -> None:
    """Tests run in parallel: several torch threads would slow them down by waiting for each other."""
    if not missing(*weights.NEEDS):
        import torch

        torch.set_num_threads(1)
        torch.manual_seed(3)


def sample_image(seed: int = 0, height: int = SIZE[0] + 32, width: int = SIZE[1] + 32) -> Any:
    """Image (height, width) of rectangles of all sizes, as of a street with many signs, slightly blurred."""
    import cv2

    rng = np.random.default_rng(seed)
    out = np.full((height, width), 128, np.uint8)
    for _ in range(400):
        x, y, w, h = rng.integers((0, 0, 4, 4), (width, height, 40, 40))
        cv2.rectangle(out, (int(x), int(y)), (int(x + w), int(y + h)), int(rng.integers(256)), -1)
    return cv2.GaussianBlur(out, (0, 0), 1.0)


def random_weights(shapes: dict[str, weights.Shape], seed: int = 0) -> dict[str, Any]:
    """Random tensors of these shapes, scaled so that activations neither vanish nor grow."""
    import torch

    made = torch.Generator().manual_seed(seed)
    out = {}
    for name, shape in shapes.items():
        fan = int(np.prod(shape[1:])) if len(shape) > 1 else 1
        value = torch.randn(shape, generator=made) * (2 / fan) ** 0.5 * (1 if len(shape) > 1 else 0.1)
        out[name] = value.abs() + 0.5 if name.endswith(("running_var", "1.weight")) and len(shape) == 1 else value
    return out


def saved(path: Path, shapes: dict[str, weights.Shape]) -> Path:
    import torch

    torch.save(random_weights(shapes), path)
    return path


def with_random_weights(name: str, folder: Path) -> features.Features:
    """A backend that can run here; networks get random weights, so that their results are arbitrary."""
    if missing_packages := plugins.missing(features.__name__, name):
        pytest.skip(f"{name} needs {missing_packages}")
    if name not in PUBLISHED_WEIGHTS:
        return features.named(name, count=500)
    from scan2sim.slam.features import aliked

    shapes = {"aliked": aliked.MODELS[1].shapes, "superpoint": SUPERPOINT}[name]
    return features.named(name, saved(folder / f"{name}.pth", shapes), count=500, device="cpu")


def with_published_weights(name: str, real_data: Path) -> features.Features:
    """A network with its published weights; the test is skipped where they are absent."""
    if missing_packages := plugins.missing(features.__name__, name):
        pytest.skip(f"{name} needs {missing_packages}")
    file = real_data / "weights" / PUBLISHED_WEIGHTS[name]
    if not file.is_file():
        pytest.skip(f"no published weights of {name}: {PUBLISHED_WEIGHTS[name]}")
    return features.named(name, file, count=500, device="cpu")


def check_keypoints_follow_translation(backend: features.Features) -> None:
    """An image translated by (8, 16) px gives the same keypoints, translated."""
    large = sample_image()
    a = np.ascontiguousarray(large[16 : 16 + SIZE[0], 16 : 16 + SIZE[1]])
    b = np.ascontiguousarray(large[: SIZE[0], 8 : 8 + SIZE[1]])  # right by 8, down by 16
    found, other = backend.detect(a), backend.detect(b)
    assert 100 < len(found.uv) <= 500
    matcher = matchers.named("nearest")
    matchers.check(backend, matcher)
    pairs = matcher.match(found, other, (SIZE[::-1], SIZE[::-1]))
    assert len(pairs) > 50 and len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
    moved = other.uv[pairs[:, 1]] - found.uv[pairs[:, 0]]
    assert (np.linalg.norm(moved - (8, 16), axis=1) < 3).mean() > 0.9  # ORB finds some in small copies of the image
    assert np.abs(np.median(moved, axis=0) - (8, 16)).max() < 0.1


def check_mask_and_flat_image(backend: features.Features) -> None:
    """No keypoints where the mask is 0, none on an image of one colour."""
    mask = np.full(SIZE, 255, np.uint8)
    mask[:, 160:] = 0
    found = backend.detect(sample_image()[: SIZE[0], : SIZE[1]], mask)
    assert len(found.uv) > 20 and found.uv[:, 0].max() < 161
    flat = backend.detect(np.full((40, 50), 90, np.uint8))
    assert flat.descriptors.shape == (0, backend.dimension)
    assert matchers.named("nearest").match(found, FeatureSet(*(x[:0] for x in found)), (SIZE, SIZE)).shape == (0, 2)


@pytest.mark.parametrize("name", plugins.names(features.__name__))
def test_every_backend_meets_the_requirements(name: str, tmp_path: Path) -> None:
    """Shapes, types, bounds, order and determinism hold for any weights."""
    backend = with_random_weights(name, tmp_path)
    image = np.ascontiguousarray(sample_image()[: SIZE[0], : SIZE[1]])
    found = backend.detect(image)
    n = len(found.uv)
    assert 0 < n <= 500
    assert found.uv.dtype == np.float32 and found.uv.shape == (n, 2)
    assert (found.uv >= 0).all() and (found.uv <= (SIZE[1] - 1, SIZE[0] - 1)).all()
    assert found.descriptors.dtype == (np.uint8 if backend.binary else np.float32)
    assert found.descriptors.shape == (n, backend.dimension) and found.scores.shape == (n,)
    if not backend.binary:
        assert np.allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-4)
    assert all(np.array_equal(x, y) for x, y in zip(found, backend.detect(image), strict=True))
    mask = np.full(SIZE, 255, np.uint8)
    mask[:, 160:] = 0
    assert (backend.detect(image, mask).uv[:, 0] < 161).all()
    flat = backend.detect(np.full((40, 50), 90, np.uint8))
    assert flat.descriptors.shape == (len(flat.uv), backend.dimension)
    assert name in backend.describe().lower()


@pytest.mark.parametrize("name", [n for n in plugins.names(features.__name__) if n not in PUBLISHED_WEIGHTS])
def test_keypoints_follow_translation(name: str) -> None:
    check_keypoints_follow_translation(features.named(name, count=500))


@pytest.mark.parametrize("name", PUBLISHED_WEIGHTS)
def test_keypoints_of_networks_follow_translation(name: str, real_data: Path) -> None:
    check_keypoints_follow_translation(with_published_weights(name, real_data))


@pytest.mark.parametrize("name", [n for n in plugins.names(features.__name__) if n not in PUBLISHED_WEIGHTS])
def test_masks_and_flat_images_have_no_keypoints(name: str) -> None:
    check_mask_and_flat_image(features.named(name, count=500))


@pytest.mark.parametrize("name", PUBLISHED_WEIGHTS)
def test_networks_find_no_keypoints_in_masks_and_flat_images(name: str, real_data: Path) -> None:
    check_mask_and_flat_image(with_published_weights(name, real_data))


def test_upsampling_does_not_shift_features() -> None:
    a = sample_image()
    found, large = (features.named("rootsift", count=500, upsample=n).detect(a) for n in (1, 2))
    pairs = matchers.named("nearest").match(found, large, (SIZE, SIZE))
    moved = large.uv[pairs[:, 1]] - found.uv[pairs[:, 0]]
    near = np.linalg.norm(moved, axis=1) < 2
    assert near.sum() > 50 and np.abs(np.median(moved[near], axis=0)).max() < 0.15


def test_weights_for_backends_without_a_network_are_rejected() -> None:
    with pytest.raises(SettingError, match="takes no weights"):
        features.named("orb", Path("superpoint_v1.pth"))
    with pytest.raises(SettingError, match="takes no weights"):
        matchers.named("nearest", Path("superglue_outdoor.pth"))


def test_aliked_with_published_weights_matches_a_rotated_image(real_data: Path) -> None:
    import cv2

    pytest.importorskip("torch")
    folder = real_data / "weights" / "aliked"
    a = sample_image(1)[: SIZE[0], : SIZE[1]]
    turn = cv2.getRotationMatrix2D((SIZE[1] / 2, SIZE[0] / 2), 25, 1.0)
    turned: Any = cv2.warpAffine(a, turn, SIZE[::-1])
    backend = features.named("aliked", folder / "aliked-n16rot.pth", count=400, device="cpu")
    assert "as published (aliked-n16rot.pth)" in backend.describe() and "BSD" in backend.describe()
    found, other = backend.detect(a), backend.detect(turned)
    pairs = matchers.named("nearest").match(found, other, (SIZE, SIZE))
    moved = found.uv[pairs[:, 0]] @ turn[:, :2].T + turn[:, 2]
    right = np.linalg.norm(other.uv[pairs[:, 1]] - moved, axis=1) < 2
    assert right.sum() > 80 and right.mean() > 0.9


def test_deformable_convolution_without_offsets_is_a_plain_one() -> None:
    torch = pytest.importorskip("torch")
    from scan2sim.slam.features.aliked import deformed

    x, kernel = torch.randn(1, 5, 9, 13), torch.randn(7, 5, 3, 3)
    plain = torch.nn.functional.conv2d(x, kernel, padding=1)
    assert torch.allclose(deformed(x, torch.zeros(1, 18, 9, 13), kernel), plain, atol=1e-4)
    shifts = torch.zeros(1, 18, 9, 13)
    shifts[:, 1::2] = 1  # all samples one pixel to the right
    assert torch.allclose(deformed(x, shifts, kernel)[..., :-1], plain[..., 1:], atol=1e-4)


# networks of transformers


def test_superpoint_file_and_folder_give_the_same_features(tmp_path: Path) -> None:
    torch, hf = pytest.importorskip("torch"), pytest.importorskip("transformers")
    from scan2sim.slam.features.superpoint import RENAMES

    file = saved(tmp_path / "superpoint_v1.pth", SUPERPOINT)
    network = hf.SuperPointForKeypointDetection(hf.SuperPointConfig(keypoint_threshold=0.5, max_keypoints=3)).eval()
    network.load_state_dict(weights.renamed(random_weights(SUPERPOINT), RENAMES))
    network.save_pretrained(tmp_path / "superpoint")
    a = sample_image(2, 99, 128)
    found, same = (
        features.named("superpoint", path, count=10**6, device="cpu").detect(a)
        for path in (file, tmp_path / "superpoint")
    )
    assert all(np.array_equal(x, y) for x, y in zip(found, same, strict=True))
    few = features.named("superpoint", file, count=20, device="cpu").detect(a)
    assert all(np.array_equal(x[:20], y) for x, y in zip(found, few, strict=True))
    assert len(found.uv) > 50 and (np.diff(found.scores) <= 0).all()
    assert found.uv.min() >= 4 and (found.uv < (124, 92)).all(), "none at the border, none in the last three rows"

    network.keypoint_decoder.keypoint_threshold, network.keypoint_decoder.max_keypoints = 0.005, -1
    with torch.inference_mode():
        out = network(torch.from_numpy(a[:96])[None, None].float().expand(1, 3, -1, -1) / 255)
    uv = (out.keypoints[0] * torch.tensor([128, 96])).round().numpy()
    inner = (uv < (124, 92)).all(axis=1)
    order, other = np.lexsort(found.uv.T), np.flatnonzero(inner)[np.lexsort(uv[inner].T)]
    assert np.array_equal(found.uv[order], uv[other])
    assert np.allclose(found.scores[order], out.scores[0].numpy()[other], atol=1e-6)
    assert np.allclose(found.descriptors[order], out.descriptors[0].numpy()[other], atol=1e-6)


def two_views(dimension: int, n: int = 120) -> tuple[FeatureSet, FeatureSet]:
    """The same features in two images of 640 x 480, in another order, slightly changed; some only in the first."""
    rng = np.random.default_rng(3)
    uv, what = rng.uniform((0, 0), (639, 479), (n, 2)), rng.normal(size=(n, dimension))
    order = rng.permutation(n)[: 3 * n // 4]

    def seen(uv: Any, what: Any) -> FeatureSet:
        length = np.linalg.norm(what, axis=1, keepdims=True)
        return FeatureSet(uv.astype(np.float32), (what / length).astype(np.float32), np.full(len(uv), 0.5, np.float32))

    return seen(uv, what), seen(uv[order] + (9, 2), what[order] + 0.2 * rng.normal(size=(len(order), dimension)))


def with_all_matches(name: str, path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A matcher that also returns improbable matches, as random weights give."""
    monkeypatch.setattr(plugins.module(matchers.__name__, name), "PROBABILITY_MIN", 0.0)
    return matchers.named(name, path, device="cpu")


def check_matches(matcher: matchers.Matcher, a: FeatureSet, b: FeatureSet) -> None:
    """Matches are unique, symmetric and independent of the images' scale."""
    size = (640, 480)
    pairs = matcher.match(a, b, (size, size))
    assert len(pairs) > 20 and pairs.dtype == np.int64
    assert all(len(np.unique(column)) == len(pairs) for column in pairs.T)
    assert pairs.min() >= 0 and (pairs.max(axis=0) < (len(a.uv), len(b.uv))).all()
    assert np.array_equal(pairs, matcher.match(a, b, (size, size)))
    back = matcher.match(b, a, (size, size))[:, ::-1]
    assert np.array_equal(pairs, back[np.argsort(back[:, 0])])
    assert np.array_equal(pairs, matcher.match(a, b._replace(uv=(b.uv / 2).astype(np.float32)), (size, (320, 240))))
    none = FeatureSet(*(x[:0] for x in b))
    assert matcher.match(a, none, (size, size)).shape == matcher.match(none, a, (size, size)).shape == (0, 2)


def expected_matches(network: Any, a: FeatureSet, b: FeatureSet, *scores: Any) -> Any:
    """(M, 2) matches that a network of transformers gives for equally many features."""
    import torch

    uv, what = (torch.from_numpy(np.stack([getattr(a, x), getattr(b, x)]))[None] for x in ("uv", "descriptors"))
    with torch.inference_mode():
        mask = torch.ones(1, 2, len(a.uv), dtype=torch.int)
        partner = network._match_image_pair(uv, what, *scores, 480, 640, mask=mask)[0].reshape(2, -1)[0].numpy()
    return np.stack([np.flatnonzero(partner >= 0), partner[partner >= 0]], axis=1)


def test_superglue_matches_equal_transformers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch, hf = pytest.importorskip("torch"), pytest.importorskip("transformers")
    network = hf.SuperGlueForKeypointMatching(hf.SuperGlueConfig(matching_threshold=0.0)).eval()
    for value in network.state_dict().values():
        if value.ndim == 1:  # biases and normalization
            value.add_(0.05 * torch.rand_like(value))
    network.save_pretrained(tmp_path / "superglue_outdoor")
    matcher = with_all_matches("superglue", tmp_path / "superglue_outdoor", monkeypatch)
    assert (matcher.takes, matcher.dimension) == ("superpoint", 256)
    a, b = two_views(256)
    check_matches(matcher, a, b)
    a = FeatureSet(*(x[: len(b.uv)] for x in a))
    scores = torch.full((1, 2, len(a.uv)), 0.5)
    assert np.array_equal(matcher.match(a, b, ((640, 480),) * 2), expected_matches(network, a, b, scores))


def published_lightglue(state: dict[str, Any]) -> dict[str, Any]:
    """Tensors of a LightGlue of transformers by the names of the published .pth files."""
    import torch

    tensors = {"posenc.Wr.weight": state["positional_encoder.projector.weight"]}
    tensors |= {name.replace("ection", ""): value for name, value in state.items() if name.startswith("input_proj")}
    for i in range(9):
        layer = f"transformer_layers.{i}"
        for x in ("weight", "bias"):
            three = torch.stack([state[f"{layer}.self_attention.{c}_proj.{x}"] for c in "qkv"])
            rest = three.shape[2:]
            three = three.reshape(3, 4, 64, *rest).permute(1, 2, 0, *range(3, 3 + len(rest))).reshape(768, *rest)
            tensors[f"self_attn.{i}.Wqkv.{x}"] = three
            tensors[f"self_attn.{i}.out_proj.{x}"] = state[f"{layer}.self_attention.o_proj.{x}"]
            for theirs, name in (("to_qk", "q_proj"), ("to_v", "v_proj"), ("to_out", "o_proj")):
                tensors[f"cross_attn.{i}.{theirs}.{x}"] = state[f"{layer}.cross_attention.{name}.{x}"]
            for kind in ("self", "cross"):
                for number, name in ((0, "fc1"), (1, "layer_norm"), (3, "fc2")):
                    tensors[f"{kind}_attn.{i}.ffn.{number}.{x}"] = state[f"{layer}.{kind}_mlp.{name}.{x}"]
            for theirs, name in (("matchability", "matchability"), ("final_proj", "final_projection")):
                tensors[f"log_assignment.{i}.{theirs}.{x}"] = state[f"match_assignment_layers.{i}.{name}.{x}"]
    return tensors


@pytest.mark.parametrize(("detector", "dimension"), [("superpoint", 256), ("aliked", 128)])
def test_lightglue_matches_equal_transformers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, detector: str, dimension: int
) -> None:
    torch, hf = pytest.importorskip("torch"), pytest.importorskip("transformers")
    point = hf.SuperPointConfig(descriptor_decoder_dim=dimension)
    thresholds = {"depth_confidence": -1.0, "width_confidence": -1.0, "filter_threshold": 0.0}
    config = hf.LightGlueConfig(keypoint_detector_config=point, **thresholds)
    network = hf.LightGlueForKeypointMatching(config).eval()
    state = network.state_dict()
    for name, value in state.items():
        value.add_(0.02 * torch.randn_like(value))
        if ".cross_attention.k_proj." in name:  # the published files have one tensor for both
            value.copy_(state[name.replace("k_proj", "q_proj")])
    file = tmp_path / f"{detector}_lightglue.pth"
    torch.save(published_lightglue(state), file)
    matcher = with_all_matches("lightglue", file, monkeypatch)
    assert (matcher.takes, matcher.dimension) == (detector, dimension)
    a, b = two_views(dimension)
    check_matches(matcher, a, b)
    if detector == "superpoint":
        network.save_pretrained(tmp_path / "lightglue_superpoint")
        same = with_all_matches("lightglue", tmp_path / "lightglue_superpoint", monkeypatch)
        assert np.array_equal(matcher.match(a, b, ((640, 480),) * 2), same.match(a, b, ((640, 480),) * 2))
    a = FeatureSet(*(x[: len(b.uv)] for x in a))
    assert np.array_equal(matcher.match(a, b, ((640, 480),) * 2), expected_matches(network, a, b))
    with pytest.raises(SettingError, match=rf"{detector} of {dimension} numbers, not for orb of 32 bytes"):
        matchers.check(features.named("orb"), matcher)


# invalid files


class Bomb:
    """A pickle that runs a command when it's read."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return os.system, (f"touch {self.mark}",)


def test_weights_of_the_wrong_model_name_both(tmp_path: Path) -> None:
    pytest.importorskip("torch"), pytest.importorskip("transformers")
    from safetensors.torch import save_file

    from scan2sim.slam.features import aliked

    point, ali = saved(tmp_path / "p.pth", SUPERPOINT), saved(tmp_path / "a.pth", aliked.MODELS[0].shapes)
    light = saved(tmp_path / "l.pth", {"posenc.Wr.weight": (32, 2), "log_assignment.0.matchability.weight": (1, 256)})
    glue, published = tmp_path / "superglue_outdoor", saved(tmp_path / "g.pth", {"kenc.encoder.0.weight": (32, 3, 1)})
    glue.mkdir()
    save_file(random_weights({"keypoint_encoder.encoder.0.linear.weight": (32, 3)}), glue / "model.safetensors")
    for file, found in ((glue, "SuperGlue"), (light, "LightGlue"), (ali, "ALIKED")):
        with pytest.raises(InputError, match=f"weights of {found}, expected SuperPoint.*superpoint_v1.pth"):
            features.named("superpoint", file)
    with pytest.raises(InputError, match="weights of SuperPoint, expected ALIKED-n16 or ALIKED-t16"):
        features.named("aliked", point)
    with pytest.raises(InputError, match="weights of LightGlue, expected SuperGlue"):
        matchers.named("superglue", light)
    with pytest.raises(InputError, match="SuperGlue as Magic Leap publishes it, expected SuperGlue.*superglue_outdoor"):
        matchers.named("superglue", published)
    with pytest.raises(InputError, match="weights of SuperPoint, expected LightGlue for SuperPoint or LightGlue"):
        matchers.named("lightglue", point)
    with pytest.raises(InputError, match="weights of LightGlue of another shape"):
        matchers.named(
            "lightglue", saved(light, {"log_assignment.0.matchability.weight": (1, 256), "self_attn.0.Wqkv.x": (5,)})
        )


def test_weights_of_another_shape_or_network_are_rejected(tmp_path: Path) -> None:
    torch, _ = pytest.importorskip("torch"), pytest.importorskip("transformers")
    file = tmp_path / "w.pth"
    tensors = random_weights(SUPERPOINT)
    torch.save(tensors | {"conv1a.weight": torch.zeros(32, 1, 3, 3)}, file)
    with pytest.raises(InputError, match="SuperPoint of another shape.*0.conv_a.weight is 32 x 1 x 3 x 3, not 64 x 1"):
        features.named("superpoint", file)
    torch.save({"layer.weight": torch.zeros(3)}, file)
    with pytest.raises(InputError, match=r"another network \(layer.weight .*expected SuperPoint"):
        features.named("superpoint", file)
    torch.save(tensors | {"convPb.bias": torch.full((65,), float("nan"))}, file)
    with pytest.raises(InputError, match="NaN or infinite values in keypoint_decoder.conv_score_b.bias"):
        features.named("superpoint", file)
    torch.save([1, 2], file)
    with pytest.raises(InputError, match="no named tensors"):
        features.named("superpoint", file)


def test_damaged_missing_and_dangerous_files_are_rejected(tmp_path: Path) -> None:
    torch, _ = pytest.importorskip("torch"), pytest.importorskip("transformers")
    from safetensors.torch import save_file

    with pytest.raises(
        SettingError, match="needs weights. Give a folder .*superpoint, with model.safetensors; or .*superpoint_v1.pth"
    ):
        features.named("superpoint")
    with pytest.raises(InputError, match="file not found.*weights aren't downloaded"):
        features.named("superpoint", tmp_path / "none.pth")
    with pytest.raises(InputError, match="model.safetensors: file not found.*weights aren't downloaded"):
        features.named("superpoint", tmp_path)
    whole = saved(tmp_path / "superpoint_v1.pth", SUPERPOINT)
    safe = tmp_path / "superpoint.safetensors"
    save_file(random_weights(SUPERPOINT), safe)
    for file in (whole, safe):
        half = tmp_path / f"half{file.suffix}"
        for size in (0, 100, file.stat().st_size // 2):
            half.write_bytes(file.read_bytes()[:size])
            with pytest.raises(InputError, match="is damaged, or no file of tensors"):
                features.named("superpoint", half)
    mark = tmp_path / "ran"
    torch.save({"conv1a.weight": Bomb(mark)}, tmp_path / "bomb.pth")
    (tmp_path / "bomb.pkl").write_bytes(pickle.dumps({"conv1a.weight": Bomb(mark)}, 2))
    for file in (tmp_path / "bomb.pth", tmp_path / "bomb.pkl"):
        with pytest.raises(InputError, match="holds code or objects besides tensors; not executed"):
            features.named("superpoint", file)
    assert not mark.exists()


def test_description_names_the_weights_and_their_licence(tmp_path: Path) -> None:
    torch, _ = pytest.importorskip("torch"), pytest.importorskip("transformers")
    file = saved(tmp_path / "superpoint_v1.pth", SUPERPOINT)
    backend = features.named("superpoint", file, device="cpu")
    description = backend.describe()
    assert (
        hashlib.sha256(file.read_bytes()).hexdigest() in description
        and "not a file known to the project" in description
    )
    assert "Magic Leap" in description and "noncommercial" in description
    torch.save({name: value.half() for name, value in random_weights(SUPERPOINT, 1).items()}, file)
    assert features.named("superpoint", file, device="cpu").detect(sample_image()).descriptors.dtype == np.float32
