"""GLB: y-up, matt, textures embedded and the right way up."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np

from scan2sim.pipeline.io import glb, textured
from scan2sim.pipeline.io.scene import whole
from tests.pipeline import made_up
from tests.present import present


def _write(folder: Path) -> Path:
    surfaces = [
        whole(group, present(textured.read(made_up.textured(folder / group, mesh))))
        for group, mesh in {"terrain": made_up.ground(), "building": made_up.house()}.items()
    ]
    glb.write(folder / "a.glb", surfaces)
    return folder / "a.glb"


def test_a_reader_gets_all_triangles_y_up(tmp_path: Path) -> None:
    import trimesh

    scene = trimesh.load_scene(_write(tmp_path), process=False)
    assert set(scene.geometry) == {"terrain_0", "terrain_1", "building_0", "building_1"}
    np.testing.assert_allclose(scene.bounds, [[-10, -0.5, -10], [10, 4.5, 10]], atol=1e-4)
    for group, mesh in {"terrain": made_up.ground(), "building": made_up.house()}.items():
        for page, (corners, uv) in made_up.by_page(mesh).items():
            part = scene.geometry[f"{group}_{page}"]
            y_up = np.stack([corners[..., 0], corners[..., 2], -corners[..., 1]], axis=-1)
            np.testing.assert_allclose(part.vertices[part.faces], y_up, atol=1e-5)
            np.testing.assert_allclose(part.visual.uv[part.faces], uv, atol=1e-6)
            assert part.visual.material.metallicFactor == 0
            assert part.visual.material.baseColorTexture.size == (256, 256)


def test_pictures_are_the_right_way_up_by_the_specification(tmp_path: Path) -> None:
    data = _write(tmp_path).read_bytes()
    assert struct.unpack("<I", data[8:12])[0] == len(data)
    length = struct.unpack("<I", data[12:16])[0]
    tree, body = json.loads(data[20 : 20 + length]), data[28 + length :]

    def view(index: int) -> bytes:
        v = tree["bufferViews"][index]
        return body[v.get("byteOffset", 0) :][: v["byteLength"]]

    def array(index: int, dtype: type, width: int) -> np.ndarray:
        a = tree["accessors"][index]
        return np.frombuffer(view(a["bufferView"])[a.get("byteOffset", 0) :], dtype)[: a["count"] * width]

    mesh = next(m for m in tree["meshes"] if m["name"] == "building_0")["primitives"][0]
    xyz = array(mesh["attributes"]["POSITION"], np.float32, 3).reshape(-1, 3)
    uv = array(mesh["attributes"]["TEXCOORD_0"], np.float32, 2).reshape(-1, 2)
    faces = array(mesh["indices"], np.uint32, 1).reshape(-1, 3)
    assert "NORMAL" in mesh["attributes"]
    texture = tree["materials"][mesh["material"]]["pbrMetallicRoughness"]["baseColorTexture"]["index"]
    jpeg = view(tree["images"][tree["textures"][texture]["source"]]["bufferView"])
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    low = uv[faces[0]].mean(axis=0), xyz[faces[0]].mean(axis=0)[1]  # lower triangle of the south wall
    high = uv[faces[1]].mean(axis=0), xyz[faces[1]].mean(axis=0)[1]
    assert low[1] < high[1]
    u, v = (low[0] * 256).astype(int)  # glTF: (0, 0) is the upper left
    assert np.abs(image[v, u].astype(int) - (40, 40, 220)).max() < 20  # blue: the picture's lower left
    u, v = (high[0] * 256).astype(int)
    assert np.abs(image[v, u].astype(int) - (220, 40, 40)).max() < 20  # red: its upper left
