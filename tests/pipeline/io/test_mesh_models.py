"""Reading of textured meshes: materials, colours, node transforms, and files in any state of damage."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from scan2sim.data_samples.building import Style
from scan2sim.data_samples.mesh_model import write
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io import gltf_features
from scan2sim.pipeline.io.mesh_files import companions, find_mesh, is_mesh
from scan2sim.pipeline.io.mesh_models import read
from scan2sim.pipeline.io.source_mesh import SourceMesh, Texels

SMALL = Style(rooms=1, furniture=0.1)
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACES = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
RED = np.full((8, 8, 3), (0, 0, 200), np.uint8)
"""OpenCV's order: blue, green, red."""


def obj(folder: Path, body: str = SQUARE + "usemtl a\n" + FACES, material: str = "map_Kd red.png") -> Path:
    """An OBJ of a square with a red texture."""
    cv2.imwrite(str(folder / "red.png"), RED)
    (folder / "m.mtl").write_text(f"newmtl a\nKd 0.2 0.2 0.2\n{material}\n", encoding="utf-8")
    (folder / "m.obj").write_text("mtllib m.mtl\n" + body, encoding="utf-8")
    return folder / "m.obj"


def centres(mesh: SourceMesh) -> F64:
    """(F, 3) colours at the centres of the faces."""
    third = np.full(len(mesh), 1 / 3, np.float32)
    return mesh.colours(np.arange(len(mesh), dtype=np.int32), third, third).astype(np.float64)


@pytest.mark.parametrize("file_format", ["obj", "glb", "ply"])
def test_colours_are_those_of_the_file(tmp_path: Path, file_format: str) -> None:
    path, made, paint = write(tmp_path, file_format=file_format, edge=0.4, style=SMALL)  # type: ignore[arg-type]
    mesh, notes = read(path)
    assert not notes
    assert len(mesh) == len(made.faces)
    assert len(mesh.mesh.vertices) == len(np.unique(made.vertices.astype(np.float32), axis=0))  # seams are welded
    assert mesh.coloured.all()
    corners = mesh.mesh.corners.astype(np.float64)
    if file_format == "glb":
        corners = corners @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # file axes to world axes
    axis = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).argmax(axis=1)
    if file_format != "ply":  # colours of vertices are coarse
        assert np.abs(centres(mesh) - paint.at(corners.mean(axis=1), axis)).mean() < 2.5
    mesh.save(tmp_path / "m.npz")
    again = SourceMesh.load(tmp_path / "m.npz")
    assert np.array_equal(centres(again), centres(mesh))


def test_texels_larger_than_the_image_average_it(tmp_path: Path) -> None:
    path = obj(tmp_path)
    checks = np.zeros((64, 64, 3), np.uint8)
    checks[::2, ::2] = checks[1::2, 1::2] = 200
    cv2.imwrite(str(tmp_path / "red.png"), checks)
    mesh, _ = read(path)
    texels = Texels(np.zeros(1, np.int32), np.array([[1 / 8, 0, 0]], np.float32), np.array([[0, 1 / 8, 0]], np.float32))
    at = np.full(1, 0.3, np.float32)
    colour = mesh.colours(np.zeros(1, np.int32), at, at, texels)
    assert np.abs(colour.astype(int) - 100).max() <= 4


def test_image_replaces_the_diffuse_factor_of_an_obj(tmp_path: Path) -> None:
    assert centres(read(obj(tmp_path))[0])[0].tolist() == [200, 0, 0]


@pytest.mark.parametrize("name", ["C:\\scans\\RED.png", "../textures/red.png", "./red.png"])
def test_images_are_found_by_their_name(tmp_path: Path, name: str) -> None:
    path = obj(tmp_path, material=f"map_Kd {name}")
    assert centres(read(path)[0])[0].tolist() == [200, 0, 0]
    assert {file.name for file in companions(path)} == {"m.mtl", "red.png"}


def test_missing_image_is_reported_and_leaves_its_faces_uncoloured(tmp_path: Path) -> None:
    mesh, notes = read(obj(tmp_path, material="map_Kd other.png"))
    assert "other.png" in notes[0]
    assert "not found" in notes[0]
    assert not mesh.coloured.any() or centres(mesh)[0].tolist() == [51, 51, 51]


def test_missing_material_file_is_reported(tmp_path: Path) -> None:
    path = obj(tmp_path)
    (tmp_path / "m.mtl").unlink()
    mesh, notes = read(path)
    assert "m.mtl" in notes[0]
    assert not mesh.coloured.any()


PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property float s
property float t
{names}element face 1
property list uchar uint vertex_indices
end_header
0 0 0 0 0{a}
1 0 0 1 0{b}
1 1 0 1 1{a}
0 1 0 0 1{b}
4 0 1 2 3
"""
"""A square as Blender writes it: texture coordinates, and no image."""


def test_texture_coordinates_without_an_image_are_no_colours(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(SQUARE + FACES, encoding="utf-8")
    (tmp_path / "m.ply").write_text(PLY.format(names="", a="", b=""), encoding="utf-8")
    for name in ("m.obj", "m.ply"):
        mesh, _ = read(tmp_path / name)
        assert not mesh.coloured.any() and not mesh.images


@pytest.mark.parametrize("material", ["", "mtllib m.mtl\nusemtl a\n"])
def test_colours_of_vertices_beside_texture_coordinates_are_used(tmp_path: Path, material: str) -> None:
    """MeshLab and Blender write both, without an image."""
    names = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    (tmp_path / "m.ply").write_text(PLY.format(names=names, a=" 200 0 100", b=" 0 50 100"), encoding="utf-8")
    (tmp_path / "m.mtl").write_text("newmtl a\nKd 0.2 0.2 0.2\n", encoding="utf-8")
    ends = " 0.8 0 0.4", " 0 0.2 0.4"
    corners = [line + (ends[i % 2] if i < 4 else "") for i, line in enumerate(SQUARE.splitlines())]
    (tmp_path / "m.obj").write_text(material + "\n".join(corners) + "\n" + FACES, encoding="utf-8")
    for name, expected in (("m.ply", (200, 0, 100)), ("m.obj", (204, 0, 102))):
        mesh, _ = read(tmp_path / name)
        assert mesh.coloured.all() and np.abs(mesh.colour.reshape(-1, 3) - expected).min(axis=0).max() <= 1
        assert np.ptp(mesh.colour[..., 0]) >= 200


def test_damaged_image_is_reported(tmp_path: Path) -> None:
    path = obj(tmp_path)
    content = (tmp_path / "red.png").read_bytes()
    (tmp_path / "red.png").write_bytes(content[: len(content) // 2])
    mesh, notes = read(path)
    assert notes
    assert not mesh.coloured.all() or not mesh.images


@pytest.mark.parametrize(
    ("body", "note", "faces"),
    [
        (SQUARE + "usemtl a\n" + FACES + "f 1/1 1/1 2/2\n", "1 degenerate", 2),
        (SQUARE + "v nan 0 0\nusemtl a\n" + FACES + "f 1/1 2/2 5/1\n", "1 degenerate", 2),
        (SQUARE + "v 2 0 0\nusemtl a\n" + FACES + "f 1/1 2/2 5/1\n", "1 degenerate", 2),  # no area
        (SQUARE + "usemtl a\nf 1 2 3\nf 1 3 4\n", "", 2),
        (SQUARE + "usemtl a\nf 1/1 2/2 3/3 4/4\n", "", 2),  # a quad
        (SQUARE + "usemtl a\n" + FACES + "f 2/1 1/1 3/1\nf 1/1 2/2 4/1\n", "", 4),  # not manifold
    ],
)
def test_bad_faces_are_removed_and_reported(tmp_path: Path, body: str, note: str, faces: int) -> None:
    mesh, notes = read(obj(tmp_path, body))
    assert len(mesh) == faces
    assert note in " ".join(notes)


@pytest.mark.parametrize(
    ("name", "content", "cause"),
    [
        ("a.obj", b"", "no faces"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no faces"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "mesh|face"),
        ("a.obj", b"v nan nan nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "area"),
        ("a.glb", b"glTF but not really", "can't be read"),
        ("a.glb", b"", "can't be read"),
        ("a.gltf", b'{"asset": {}}', "mesh|face"),
        ("a.gltf", b'{"asset": {"version": "2.0"}, "buffers": [{"uri": "away.bin", "byteLength": 12}]}', "mesh|face"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nelement face 3\nend_header\n",
            "mesh|face",
        ),
        ("a.stl", b"solid", "is not a mesh"),
    ],
)
def test_unusable_files_are_errors_that_name_the_cause(tmp_path: Path, name: str, content: bytes, cause: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=cause) as raised:
        read(tmp_path / name)
    assert name in str(raised.value)


def test_utm_coordinates_keep_millimetres(tmp_path: Path) -> None:
    body = "\n".join(
        f"v {x} {y} {z}" for x, y, z in [(500000.123, 5400000.456, 310.5), (500001.123, 5400000.456, 310.5),
                                         (500001.123, 5400001.456, 310.5)]
    )  # fmt: skip
    mesh, _ = read(obj(tmp_path, body + "\nf 1 2 3\n"))
    world = mesh.mesh.vertices.astype(np.float64) + mesh.mesh.frame.origin
    assert np.abs(world.min(axis=0) - (500000.123, 5400000.456, 310.5)).max() < 1e-3


def test_mirrored_node_keeps_the_front_side(tmp_path: Path) -> None:
    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 1, 2]], process=False)
    scene = trimesh.Scene()
    scene.add_geometry(square, transform=np.diag([-1.0, 1, 1, 1]))
    scene.export(tmp_path / "m.glb")
    mesh, _ = read(tmp_path / "m.glb")
    assert mesh.mesh.face_normal[0, 2] > 0.9


def test_ply_is_a_mesh_only_if_it_has_faces(tmp_path: Path) -> None:
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 1, 2]], process=False).export(tmp_path / "mesh.ply")
    trimesh.PointCloud(np.zeros((3, 3))).export(tmp_path / "cloud.ply")
    assert is_mesh(tmp_path / "mesh.ply")
    assert not is_mesh(tmp_path / "cloud.ply")
    assert find_mesh(tmp_path) == tmp_path / "mesh.ply"


def test_folder_with_two_meshes_names_them(tmp_path: Path) -> None:
    obj(tmp_path)
    (tmp_path / "n.obj").write_bytes((tmp_path / "m.obj").read_bytes())
    with pytest.raises(InputError, match=r"m\.obj, n\.obj"):
        find_mesh(tmp_path)


PLY_HEADER = """ply
format ascii 1.0
{textures}element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
property list uchar float texcoord
{number}end_header
0 0 0
1 0 0
1 1 0
0 1 0
"""


def pages(folder: Path, numbers: tuple[str, str], textures: int = 2) -> Path:
    """A PLY of a square as OpenMVS writes it: two triangles, each with the texture image of its number."""
    for name, bgr in (("a 0.png", (0, 0, 200)), ("a 1.png", (0, 150, 0))):
        cv2.imwrite(str(folder / name), np.full((8, 8, 3), bgr, np.uint8))
    named = "".join(f"comment TextureFile a {i}.png\n" for i in range(textures))
    number = "property int texnumber\n" if numbers[0] else ""
    header = PLY_HEADER.format(textures=named, number=number)
    faces = f"3 0 1 2 6 0 0 1 0 1 1 {numbers[0]}\n3 0 2 3 6 0 0 1 1 0 1 {numbers[1]}\n"
    (folder / "m.ply").write_text(header + faces, encoding="utf-8")
    return folder / "m.ply"


def test_faces_of_a_ply_with_several_textures_get_their_own(tmp_path: Path) -> None:
    path = pages(tmp_path, ("1", "0"))
    mesh, notes = read(path)
    assert not notes and len(mesh) == 2
    left = mesh.mesh.corners[:, :, 0].mean(axis=1) < 0.5  # the second triangle of the file
    assert centres(mesh)[left].tolist() == [[200, 0, 0]] and centres(mesh)[~left].tolist() == [[0, 150, 0]]
    assert {file.name for file in companions(path)} == {"a 0.png", "a 1.png"}
    (tmp_path / "a 1.png").unlink()
    mesh, notes = read(path)
    assert "a 1.png: not found" in notes[0] and mesh.coloured.sum() == 1


def test_a_ply_with_several_textures_and_no_numbers_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"several texture images, but no `texnumber`.*as OBJ"):
        read(pages(tmp_path, ("", "")))
    mesh, _ = read(pages(tmp_path, ("", ""), textures=1))
    assert centres(mesh).tolist() == [[200, 0, 0]] * 2


TRANSFORM: dict[str, Any] = {"extensions": {"KHR_texture_transform": {"offset": [0.5, 0.0]}}}


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "compressed by meshoptimizer"),
        ({"extensionsRequired": ["KHR_texture_basisu"]}, r"KTX 2.*JPEG or PNG"),
        (
            {"materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0} | TRANSFORM}}]},
            "texture_transform",
        ),
        ({"materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"texCoord": 1}}}]}, "second set of texture"),
        ({"accessors": [{"componentType": 5122, "normalized": True}]}, "POSITION as normalized integers"),
    ],
)
def test_gltf_features_that_would_be_read_wrongly_are_refused(
    tmp_path: Path, change: dict[str, Any], cause: str
) -> None:
    body = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126}],
    }
    (tmp_path / "m.gltf").write_text(json.dumps(body | change), encoding="utf-8")
    content = json.dumps(body | change).encode()
    glb = b"glTF" + (2).to_bytes(4, "little") + (20 + len(content)).to_bytes(4, "little")
    (tmp_path / "m.glb").write_bytes(glb + len(content).to_bytes(4, "little") + b"JSON" + content)
    for name in ("m.gltf", "m.glb"):
        with pytest.raises(InputError, match=cause):
            read(tmp_path / name)


def test_a_texture_transform_that_changes_nothing_is_accepted(tmp_path: Path) -> None:
    same = {"KHR_texture_transform": {"offset": [0, 0], "rotation": 0, "scale": [1, 1]}}
    body = {"materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": same}}}]}
    (tmp_path / "m.gltf").write_text(json.dumps(body), encoding="utf-8")
    gltf_features.check(tmp_path / "m.gltf")
