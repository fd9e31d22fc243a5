"""GLB: y-up, matt, embedded textures with the correct orientation, all encodings, and the source photo of faces."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.errors import SettingError, UnavailableError
from scan2sim.pipeline.core.types import Camera, View
from scan2sim.pipeline.io.worlds import glb, provenance, textured_mesh
from scan2sim.pipeline.io.worlds.glb import GlbParams
from scan2sim.pipeline.io.worlds.scene import Surface, group_surface
from tests.fakes import synthetic
from tests.present import present

GROUPS = {"terrain": synthetic.ground(), "building": synthetic.house()}
DTYPE: dict[int, Any] = {5120: np.int8, 5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}
EXTENSION = {"meshopt": "EXT_meshopt_compression", "draco": "KHR_draco_mesh_compression"}


def surfaces(folder: Path) -> list[Surface]:
    return [
        group_surface(group, present(textured_mesh.read(synthetic.textured(folder / group, mesh))))
        for group, mesh in GROUPS.items()
    ]


def written(folder: Path, **params: Any) -> Path:
    glb.write(folder / "a.glb", surfaces(folder), GlbParams(**params))
    return folder / "a.glb"


class File:
    """Content of a GLB file, read by the specification."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        assert struct.unpack("<I", data[8:12])[0] == len(data)
        length = struct.unpack("<I", data[12:16])[0]
        self.tree, self.body = json.loads(data[20 : 20 + length]), data[28 + length :]

    def view(self, index: int) -> bytes:
        view = self.tree["bufferViews"][index]
        packed = view.get("extensions", {}).get(EXTENSION["meshopt"])
        if packed is None:
            return self.body[view.get("byteOffset", 0) :][: view["byteLength"]]
        import meshopt

        data = self.body[packed["byteOffset"] :][: packed["byteLength"]]
        how = packed["mode"], packed.get("filter", "NONE")
        return bytes(meshopt.decode_gltf_buffer(data, packed["count"], packed["byteStride"], *how))

    def array(self, index: int) -> np.ndarray:
        about = self.tree["accessors"][index]
        dtype, columns = np.dtype(DTYPE[about["componentType"]]), COLUMNS[about["type"]]
        stride = self.tree["bufferViews"][about["bufferView"]].get("byteStride", dtype.itemsize * columns)
        rows = np.frombuffer(self.view(about["bufferView"]), np.uint8)[: about["count"] * stride].reshape(-1, stride)
        values = np.ascontiguousarray(rows[:, : dtype.itemsize * columns]).view(dtype)
        return values / np.iinfo(dtype).max if about.get("normalized") else values

    def mesh(self, name: str) -> dict[str, np.ndarray]:
        """Attributes and `faces` of a mesh."""
        one = next(mesh for mesh in self.tree["meshes"] if mesh["name"] == name)["primitives"][0]
        packed = one.get("extensions", {}).get(EXTENSION["draco"])
        if packed is None:
            found = {key: self.array(index) for key, index in one["attributes"].items()}
            return {**found, "faces": self.array(one["indices"]).reshape(-1, 3)}
        import DracoPy

        read = DracoPy.decode(self.view(packed["bufferView"]))
        of = {attribute["unique_id"]: attribute["data"] for attribute in read.attributes}
        found = {key: of[packed["attributes"][key]] for key in one["attributes"]}
        for key, index in one["attributes"].items():
            about = self.tree["accessors"][index]
            assert about["count"] == len(found[key])
            assert not about.get("normalized") or found[key].dtype == np.uint8
            found[key] = found[key] / 255 if about.get("normalized") else found[key]
        return {**found, "faces": read.faces}

    def page(self, name: str) -> np.ndarray:
        """RGB of a mesh's texture."""
        one = next(mesh for mesh in self.tree["meshes"] if mesh["name"] == name)["primitives"][0]
        material = self.tree["materials"][one["material"]]["pbrMetallicRoughness"]
        texture = self.tree["textures"][material["baseColorTexture"]["index"]]
        source = texture.get("source", next((e["source"] for e in texture.get("extensions", {}).values()), None))
        data = self.view(self.tree["images"][source]["bufferView"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]


def test_all_triangles_are_read_y_up(tmp_path: Path) -> None:
    import trimesh

    scene = trimesh.load_scene(written(tmp_path), process=False)
    assert set(scene.geometry) == {"terrain_0", "terrain_1", "building_0", "building_1"}
    np.testing.assert_allclose(scene.bounds, [[-10, -0.5, -10], [10, 4.5, 10]], atol=1e-4)
    for group, mesh in GROUPS.items():
        for page, (corners, uv) in synthetic.by_page(mesh).items():
            part = scene.geometry[f"{group}_{page}"]
            y_up = np.stack([corners[..., 0], corners[..., 2], -corners[..., 1]], axis=-1)
            np.testing.assert_allclose(part.vertices[part.faces], y_up, atol=1e-5)
            np.testing.assert_allclose(part.visual.uv[part.faces], uv, atol=1e-6)
            assert part.visual.material.metallicFactor == 0
            assert part.visual.material.baseColorTexture.size == (256, 256)


@pytest.mark.parametrize("codec", ["plain", "meshopt", "draco"])
def test_packed_geometry_is_the_same_to_a_millimetre(tmp_path: Path, codec: str) -> None:
    if codec != "plain":
        pytest.importorskip({"meshopt": "meshopt", "draco": "DracoPy"}[codec], reason="scan2sim[gltf] isn't installed")
    file = File(written(tmp_path, glb_mesh=codec, glb_lit=True))
    assert file.tree.get("extensionsRequired", []) == {
        "plain": [], "meshopt": [EXTENSION["meshopt"], "KHR_mesh_quantization"], "draco": [EXTENSION["draco"]],
    }[codec]  # fmt: skip
    for group, mesh in GROUPS.items():
        for page, (corners, uv) in synthetic.by_page(mesh).items():
            part = file.mesh(f"{group}_{page}")
            y_up = np.stack([corners[..., 0], corners[..., 2], -corners[..., 1]], axis=-1)
            wanted = np.concatenate([y_up, uv[..., :1], 1 - uv[..., 1:]], axis=-1)
            got = np.concatenate([part["POSITION"], part["TEXCOORD_0"]], axis=-1)[part["faces"]]
            assert max_corner_distance(got, wanted) < (0.0006 if codec != "plain" else 1e-6)
            assert np.abs(np.linalg.norm(part["NORMAL"], axis=1) - 1).max() < 0.02


def max_corner_distance(got: np.ndarray, wanted: np.ndarray) -> float:
    """Largest distance of corners of triangles (F, 3, k) from the expected ones, which must be matched one to one."""
    turns = np.concatenate([np.roll(wanted, turn, axis=1) for turn in range(3)])  # with any corner first
    far, which = cKDTree(turns.reshape(len(turns), -1)).query(got.reshape(len(got), -1), p=np.inf)
    assert len(np.unique(which % len(wanted))) == len(wanted) == len(got)
    return float(far.max())


@pytest.mark.parametrize("texture", ["jpeg", "webp"])
def test_texture_orientation_follows_the_specification(tmp_path: Path, texture: str) -> None:
    file = File(written(tmp_path, glb_texture=texture))
    part, image = file.mesh("building_0"), file.page("building_0")
    xyz, uv, faces = part["POSITION"], part["TEXCOORD_0"], part["faces"]
    low = uv[faces[0]].mean(axis=0), xyz[faces[0]].mean(axis=0)[1]  # lower triangle of the south wall
    high = uv[faces[1]].mean(axis=0), xyz[faces[1]].mean(axis=0)[1]
    assert low[1] < high[1]
    u, v = (low[0] * 256).astype(int)  # glTF: (0, 0) is the upper left
    assert np.abs(image[v, u].astype(int) - (40, 40, 220)).max() < 20  # blue: lower left of the image
    u, v = (high[0] * 256).astype(int)
    assert np.abs(image[v, u].astype(int) - (220, 40, 40)).max() < 20  # red: upper left


def test_materials_are_unlit_by_default(tmp_path: Path) -> None:
    shown = File(written(tmp_path / "shown"))
    lit = File(written(tmp_path / "lit", glb_lit=True))
    assert all(material["extensions"] == {"KHR_materials_unlit": {}} for material in shown.tree["materials"])
    assert "extensions" not in lit.tree["materials"][0] and "NORMAL" in lit.mesh("terrain_0")
    assert "NORMAL" not in shown.mesh("terrain_0")


def test_each_face_has_its_photo_and_distance(tmp_path: Path) -> None:
    ground, house = surfaces(tmp_path)
    photo = np.where(np.arange(len(ground.shape)) % 2, 0, -1).astype(np.int32)  # photo of every other face
    ground = replace(ground, shape=replace(ground.shape, photo=photo))
    filled = np.full((256, 256), 64, np.uint8)
    cv2.imwrite(str(house.shape.seen[1]), filled)
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 30
    camera = Camera("pinhole", 640, 480, 500, 500, 320, 240)
    views = [View("first", camera, pose, tmp_path / "first.jpg", time=211_846_418.0)]
    glb.write(tmp_path / "a.glb", [ground, house], GlbParams(), views=views)
    file = File(tmp_path / "a.glb")
    table = file.tree["extensions"]["EXT_structural_metadata"]["propertyTables"][0]
    assert table["count"] == 4 and provenance.table(views)[3] == provenance.Row(
        "photo", "first", "2018-06-01T00:00:00+00:00"
    )
    assert file.view(table["properties"]["photo"]["values"]) == b"first"
    assert file.view(table["properties"]["taken"]["values"]) == b"2018-06-01T00:00:00+00:00"
    part = file.mesh("terrain_0")
    row, far = part["_FEATURE_ID_0"][part["faces"]][..., 0], part["_DISTANCE"][part["faces"]][..., 0]
    assert (row == row[:, :1]).all() and set(row.ravel()) == {provenance.PHOTO, provenance.FIRST_VIEW_ROW}
    x, y, z = np.moveaxis(part["POSITION"][part["faces"]], -1, 0)
    true = np.linalg.norm([x - 1, -z - 2, y - 30], axis=0)
    np.testing.assert_allclose(far[row == 3], true[row == 3], atol=1e-3)
    assert (far[row != 3] == provenance.UNKNOWN_DISTANCE).all()
    assert (file.mesh("building_1")["_FEATURE_ID_0"] == provenance.FILLED).all()


@pytest.mark.parametrize("codec", ["plain", "meshopt", "draco"])
def test_vertices_have_their_reflectance(tmp_path: Path, codec: str) -> None:
    if codec != "plain":
        pytest.importorskip({"meshopt": "meshopt", "draco": "DracoPy"}[codec], reason="scan2sim[gltf] isn't installed")
    ground, house = surfaces(tmp_path)
    level = ((ground.shape.mesh.vertices[:, 0] + 10) / 20).astype(np.float32)  # 0 in the west, 1 in the east
    ground = replace(ground, shape=replace(ground.shape, reflectance=level))
    glb.write(tmp_path / "a.glb", [ground, house], GlbParams(glb_mesh=codec))
    file = File(tmp_path / "a.glb")
    for page in (0, 1):
        part = file.mesh(f"terrain_{page}")
        assert np.abs(part["_REFLECTANCE"].ravel() - (part["POSITION"][:, 0] + 10) / 20).max() < 0.003
    assert "_REFLECTANCE" not in file.mesh("building_0")
    glb.write(tmp_path / "b.glb", [ground], GlbParams(reflectance=False))
    assert "_REFLECTANCE" not in File(tmp_path / "b.glb").mesh("terrain_0")


def test_unavailable_encoders_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for setting in ({"glb_texture": "bmp"}, {"glb_mesh": "zip"}):
        with pytest.raises(SettingError, match=r"export\.glb_"):
            glb.find_encoders(GlbParams(**setting))
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(UnavailableError, match="basisu or toktx"):
        glb.find_encoders(GlbParams(glb_texture="ktx2"))
