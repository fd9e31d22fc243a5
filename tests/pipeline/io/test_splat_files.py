"""Splats as other programs read them: PLY and SPZ by gsply, glTF by its own accessors."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("gsply", reason="the extra splats isn't installed")

from scan2sim.pipeline.core import splats as layers
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.splats import MAX_COLOUR, MIN_COLOUR, PHOTO_WIDTH, RGB, SplatLayer, Splats
from scan2sim.pipeline.io import splat_files
from scan2sim.pipeline.io.worlds.gltf import splats as gltf

OFFSET = np.array([100.0, -50.0, 3.0])


def some(number: int = 500, seed: int = 1) -> Splats:
    random = np.random.default_rng(seed)
    return Splats.of(
        random.uniform(-30, 30, (number, 3)), np.exp(random.uniform(-5, 0, (number, 3))),
        random.normal(size=(number, 4)), random.uniform(0.05, 0.95, number), random.uniform(0.02, 0.98, (number, 3)),
    )  # fmt: skip


def shape(splats: Splats) -> np.ndarray:
    """(N, 3, 3) covariances."""
    w, x, y, z = splats.quaternion.T.astype(float)
    axes = Rotation.from_quat(np.column_stack([x, y, z, w])).as_matrix() * splats.scale[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


@pytest.mark.parametrize(
    ("suffix", "metres", "relative", "level"), [(".ply", 1e-5, 1e-5, 1e-5), (".spz", 5e-4, 0.08, 0.02)]
)
def test_files_hold_the_splats_in_world_metres(
    tmp_path: Path, suffix: str, metres: float, relative: float, level: float
) -> None:
    given = some()
    splat_files.write(tmp_path / f"a{suffix}", given, OFFSET)
    found = splat_files.read(tmp_path / f"a{suffix}")
    assert len(found) == len(given)
    assert np.abs(found.xyz - (given.xyz + OFFSET)).max() < metres
    assert np.abs(found.rgb - given.rgb).max() < level and np.abs(found.opacity - given.opacity).max() < level
    size = np.linalg.norm(shape(given), axis=(1, 2))
    assert (np.linalg.norm(shape(found) - shape(given), axis=(1, 2)) / size).max() < 2 * relative + 1e-4


def test_spz_is_small(tmp_path: Path) -> None:
    for suffix in (".ply", ".spz"):
        splat_files.write(tmp_path / f"a{suffix}", some(20_000), np.zeros(3))
    assert (tmp_path / "a.spz").stat().st_size < 0.35 * (tmp_path / "a.ply").stat().st_size


def test_viewers_know_the_layout_of_ply_and_the_version_of_spz(tmp_path: Path) -> None:
    for suffix in (".ply", ".spz"):
        splat_files.write(tmp_path / f"a{suffix}", some(), np.zeros(3))
    head = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode()
    names = [line.split()[2] for line in head.splitlines() if line.startswith("property float")]
    # what SuperSplat, three.js and UnityGaussianSplatting need
    needed = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    needed += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert [name for name in names if name not in ("nx", "ny", "nz")] == needed
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert content[:4] == b"NGSP" and struct.unpack_from("<I", content, 4) == (3,)


@pytest.mark.parametrize(("away", "metres"), [(2040.0, 6e-4), (3000.0, 1e-3), (20_000.0, 5e-3)])
def test_spz_holds_positions_far_from_the_origin(tmp_path: Path, away: float, metres: float) -> None:
    """As finely as it can: half a step, and that of the 32-bit floats which are written and read."""
    given, offset = some(), np.array([away, 0, 0])
    splat_files.write(tmp_path / "a.spz", given, offset)
    assert np.abs(splat_files.read(tmp_path / "a.spz").xyz - (given.xyz + offset)).max() < metres


def test_positions_beyond_spz_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"32,768 m.*Write PLY"):
        splat_files.write(tmp_path / "a.spz", some(), np.array([32_760.0, 0, 0]))
    assert not (tmp_path / "a.spz").exists()


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".glb"])
def test_what_is_brighter_than_white_is_white_in_files(tmp_path: Path, suffix: str) -> None:
    given = some()
    given.parameters[:, RGB] *= 2
    given.parameters[:5, RGB] = MIN_COLOUR
    path = tmp_path / f"a{suffix}"
    if suffix == ".glb":
        gltf.write(path, given, OFFSET)
        harmonic = accessors(path)[1]["KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"]
        rgb = np.asarray(harmonic * splat_files.SH_C0 + 0.5, np.float32)
    else:
        splat_files.write(path, given, OFFSET)
        rgb = splat_files.read(path).rgb
    assert (given.rgb > 1.2).any() and np.abs(rgb - np.clip(given.rgb, 0, 1)).max() < 0.02


def accessors(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The JSON of a GLB, and the attributes of its only primitive."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    binary = data[28 + length :]
    found = {}
    (primitive,) = tree["meshes"][0]["primitives"]
    for name, index in primitive["attributes"].items():
        accessor = tree["accessors"][index]
        view = tree["bufferViews"][accessor["bufferView"]]
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        values = np.frombuffer(binary, kind, accessor["count"] * columns, view["byteOffset"])
        found[name] = values.reshape(-1, columns)
    return tree, found


def test_gltf_has_the_same_ellipsoids_with_y_up(tmp_path: Path) -> None:
    given = some()
    gltf.write(tmp_path / "a.glb", given, OFFSET)
    tree, found = accessors(tmp_path / "a.glb")
    assert tree["extensionsUsed"] == ["KHR_gaussian_splatting"] and "extensionsRequired" not in tree
    assert tree["nodes"][0]["translation"] == [100.0, 3.0, 50.0]
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    assert np.allclose(found["POSITION"], given.xyz @ turn.T, atol=1e-5)
    axes = Rotation.from_quat(found["KHR_gaussian_splatting:ROTATION"]).as_matrix()
    scaled = axes * found["KHR_gaussian_splatting:SCALE"][:, None, :]
    assert np.allclose(scaled @ scaled.transpose(0, 2, 1), turn @ shape(given) @ turn.T, rtol=1e-3, atol=1e-6)
    assert np.allclose(found["KHR_gaussian_splatting:OPACITY"][:, 0], given.opacity, atol=1e-6)
    colour = found["KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"] * splat_files.SH_C0 + 0.5
    assert np.allclose(colour, given.rgb, atol=1e-5)
    linear = np.where(given.rgb <= 0.04045, given.rgb / 12.92, ((given.rgb + 0.055) / 1.055) ** 2.4)
    assert np.allclose(found["COLOR_0"][:, :3] / 255, linear, atol=3e-3)


def test_a_layer_is_stored_and_read(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    background = random.uniform(MIN_COLOUR, MAX_COLOUR, size=(8, 16, 3)).astype(np.float32)
    photos = random.uniform(size=(3, PHOTO_WIDTH)).astype(np.float32)
    SplatLayer(some(), background, photos, ("left_1242x375", "rück_640x480")).save(tmp_path / "a.npz")
    read = SplatLayer.load(tmp_path / "a.npz")
    assert np.array_equal(read.splats.parameters, some().parameters)
    assert np.abs(read.background - background).max() < 0.001 and np.array_equal(read.photos, photos)
    assert read.cameras == ("left_1242x375", "rück_640x480") and SplatLayer.count(tmp_path / "a.npz") == len(some())


def test_a_layer_of_an_earlier_version_is_read(tmp_path: Path) -> None:
    background = np.random.default_rng(1).integers(0, 256, (8, 16, 3)).astype(np.uint8)
    np.savez_compressed(tmp_path / "a.npz", parameters=some().parameters, background=background)
    read = SplatLayer.load(tmp_path / "a.npz")
    assert np.allclose(read.background * 255, background, atol=1e-3) and not len(read.photos) and not read.cameras


@pytest.mark.parametrize(("version", "remedy"), [(2, "Run again"), (layers.VERSION + 1, "Update scan2sim")])
def test_a_layer_of_an_unknown_version_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: int, remedy: str
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(layers, "VERSION", version)
        SplatLayer.nothing().save(tmp_path / "a.npz")
    with pytest.raises(InputError, match=f"version {version}.*{remedy}"):
        SplatLayer.load(tmp_path / "a.npz")


def test_the_background_becomes_a_shell_of_its_colours() -> None:
    background = np.zeros((64, 128, 3), np.float32)
    background[:, 64:] = (0.2, 0.4, 0.9)  # directions with positive y
    layer = SplatLayer(some(), background)
    whole = layer.with_shell()
    assert np.array_equal(whole.parameters[:500], some().parameters)
    shell = Splats(whole.parameters[500:])
    away = shell.xyz - np.median(some().xyz, axis=0)
    assert np.allclose(np.linalg.norm(away, axis=1), 400, rtol=1e-3) and 5_000 < len(shell) < 20_000
    blue = (away[:, 1] > 20) & (np.abs(away[:, 0]) < 380)
    assert np.abs(shell.rgb[blue] - (0.2, 0.4, 0.9)).max() < 0.02
    thin = shell.scale[0]
    axes = Rotation.from_quat(shell.quaternion[:1][:, [1, 2, 3, 0]]).as_matrix()[0]
    assert thin[2] < 0.1 * thin[0] and abs(axes[:, 2] @ away[0]) == pytest.approx(400, rel=1e-2)
