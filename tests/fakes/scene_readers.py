"""What others read of an exported scene: a reader a format, by its users' own libraries."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.io.worlds.scene import Scene
from tests.fakes import synthetic


@dataclass(frozen=True)
class Shown:
    """A mesh as a reader shows it.

    Attributes:
        label: its class, as a code or by name.
        corners: (F, 3, 3) metres from the scene's origin, z up.
        uv: (F, 3, 2), origin at the lower left.
        image: (H, W, 3) RGB.
    """

    label: int | str
    corners: np.ndarray
    uv: np.ndarray
    image: np.ndarray


def image(path: Path) -> np.ndarray:
    """Name of a file, ASCII and without spaces."""
    assert path.name.isascii() and " " not in path.name
    read = cv2.imread(str(path))
    assert read is not None, path
    return read[..., ::-1]


def obj(path: Path) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Corners, texture coordinates and picture of each material of an OBJ."""
    rows: dict[str, list[list[str]]] = {"v": [], "vt": [], "usemtl": [], "mtllib": []}
    faces: dict[str, list[list[str]]] = {}
    for key, *words in map(str.split, path.read_text("ascii").splitlines()):
        rows.setdefault(key, []).append(words)
        if key == "f":
            faces.setdefault(rows["usemtl"][-1][0], []).append(words)
    v, vt = np.array(rows["v"], float), np.array(rows["vt"], float)
    pictures, last = {}, ""
    for key, *words in map(
        str.split, filter(None, (path.parent / rows["mtllib"][0][0]).read_text(encoding="utf-8").splitlines())
    ):
        last = words[0] if key == "newmtl" else last
        if key == "map_Kd":
            pictures[last] = image(path.parent / words[0])
    for name, corners in faces.items():
        index = np.array([[corner.split("/")[:2] for corner in face] for face in corners], int) - 1
        yield v[index[..., 0]], vt[index[..., 1]], pictures[name]


def gazebo(folder: Path, scene: Scene) -> Iterator[Shown]:
    world = ET.parse(folder / f"{scene.name}.sdf").getroot()
    for include in world.iter("include"):
        name = include.findtext("uri", "").removeprefix("model://")
        offset = np.array(include.findtext("pose", "").split()[:3], float)
        for visual in ET.parse(folder / "models" / name / "model.sdf").getroot().iter("visual"):
            file = folder / "models" / visual.findtext("geometry/mesh/uri", "").removeprefix("model://")
            for corners, uv, picture in obj(file):
                yield Shown(int(visual.findtext("plugin/label", "0")), corners + offset, uv, picture)


def glb(folder: Path, scene: Scene) -> Iterator[Shown]:
    import trimesh

    for tile in scene.with_dome:
        read = trimesh.load_scene(folder / f"{tile.name}.glb", process=False)
        for node in read.graph.nodes_geometry:
            transform, name = read.graph[node]
            mesh = read.geometry[name]
            world = mesh.vertices @ transform[:3, :3].T + transform[:3, 3]
            corners = np.stack([world[:, 0], -world[:, 2], world[:, 1]], axis=1)[mesh.faces]
            picture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
            yield Shown(mesh.metadata["class"], corners, mesh.visual.uv[mesh.faces], picture)


def usd(folder: Path, scene: Scene) -> Iterator[Shown]:
    from pxr import Usd, UsdGeom, UsdSemantics, UsdShade

    stage = Usd.Stage.Open(str(folder / f"{scene.name}.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Mesh) or UsdGeom.Imageable(prim).ComputePurpose() != "default":
            continue
        mesh = UsdGeom.Mesh(prim)
        assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
        place = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim))
        index = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        corners = (np.array(mesh.GetPointsAttr().Get()) @ place[:3, :3] + place[3, :3])[index]
        uv = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").ComputeFlattened()).reshape(-1, 3, 2)
        (label,) = UsdSemantics.LabelsAPI(prim, "class").GetLabelsAttr().Get()
        for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
            look = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0]
            page = UsdShade.Shader(stage.GetPrimAtPath(look.GetPath().AppendChild("page")))
            file = Path(page.GetInput("file").Get().resolvedPath)
            faces = np.array(subset.GetIndicesAttr().Get())
            yield Shown(label, corners[faces], uv[faces], image(file))


def mujoco(folder: Path, scene: Scene) -> Iterator[Shown]:
    mj = pytest.importorskip("mujoco", reason="mujoco is not installed")
    model = mj.MjModel.from_xml_path(str(folder / f"{scene.name}.xml"))
    data = mj.MjData(model)
    mj.mj_forward(model, data)
    for geom in np.flatnonzero(model.geom_type == mj.mjtGeom.mjGEOM_MESH):
        mesh = model.geom_dataid[geom]
        v = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        uv = model.mesh_texcoord[model.mesh_texcoordadr[mesh] :][: model.mesh_texcoordnum[mesh]]
        face = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
        world = v @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        texture = model.mat_texid[model.geom_matid[geom]].max()
        height, width = model.tex_height[texture], model.tex_width[texture]
        start, channels = model.tex_adr[texture], model.tex_nchannel[texture]
        picture = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)
        corner_uv = uv[model.mesh_facetexcoord[face]] * (1, -1) + (0, 1)  # its pictures begin at v = 0
        yield Shown(int(model.geom_user[geom, 0]), world[model.mesh_face[face]], corner_uv, picture[..., :3])


def urdf(folder: Path, scene: Scene) -> Iterator[Shown]:
    robot = ET.parse(folder / f"{scene.name}.urdf").getroot()
    places = {"world": np.zeros(3)}
    for joint in robot.iter("joint"):
        parent, child, origin = joint.find("parent"), joint.find("child"), joint.find("origin")
        assert parent is not None and child is not None and origin is not None
        places[child.attrib["link"]] = places[parent.attrib["link"]] + np.array(origin.attrib["xyz"].split(), float)
    for link in robot.iter("link"):
        for mesh in link.iterfind("visual/geometry/mesh"):
            ((corners, uv, picture),) = obj(folder / mesh.attrib["filename"])
            name = link.attrib["name"]
            yield Shown(int(name.split("/")[-1]), corners + places[name], uv, picture)


def tiles3d(folder: Path, scene: Scene) -> Iterator[Shown]:
    import trimesh
    from pyproj import Transformer

    tileset = json.loads((folder / "tileset.json").read_text(encoding="utf-8"))
    x, y, z, *axes = tileset["root"]["boundingVolume"]["box"]
    low, high = (np.array([x, y, z]) + sign * np.diag(np.reshape(axes, (3, 3))) for sign in (-1, 1))
    for tile in tileset["root"]["children"]:
        place = np.reshape(tile["transform"], (4, 4)).T
        read = trimesh.load_scene(folder / tile["content"]["uri"], process=False)
        for name, mesh in read.geometry.items():
            v = mesh.vertices.astype(float)
            world = np.stack([v[:, 0], -v[:, 2], v[:, 1]], axis=1) @ place[:3, :3].T + place[:3, 3]
            assert (world > low - 0.01).all() and (world < high + 0.01).all(), name
            if scene.frame.crs != "local":
                lon, lat, up = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*world.T)
                east, north = Transformer.from_crs("EPSG:4979", scene.frame.crs, always_xy=True).transform(lon, lat)[:2]
                world = np.stack([east, north, up], axis=1) - scene.origin
            picture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
            yield Shown(mesh.metadata["class"], world[mesh.faces], mesh.visual.uv[mesh.faces], picture)


TAGS = {"Terrain": 2, "Building": 6, "TrafficSign": 64}


def carla(folder: Path, scene: Scene) -> Iterator[Shown]:
    packages = [json.loads(path.read_text(encoding="utf-8")) for path in sorted((folder / "carla").glob("*.json"))]
    maps, props = ([entry for package in packages for entry in package[kind]] for kind in ("maps", "props"))
    files = {file: "" for ground in maps for file in ground.get("tiles", [ground.get("source")])}
    for file, tag in (files | {prop["source"]: prop["tag"] for prop in props}).items():
        for name, corners, uv, picture in fbx(folder / "carla" / file):
            kind = tag or name.removeprefix(f"{scene.name}_").split("_")[0]
            yield Shown(TAGS[kind], corners, uv, image(picture))


def fbx(path: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray, Path]]:
    """Name, corners (metres), texture coordinates and picture of each mesh, by assimp."""
    assimp = pytest.importorskip("assimp_py", reason="assimp-py is not installed")
    read = assimp.import_file(str(path), assimp.Process_Triangulate)
    for mesh in read.meshes:
        index = np.asarray(mesh.indices).reshape(-1, 3)
        corners = np.asarray(mesh.vertices, float).reshape(-1, 3)[index] / 100
        uv = np.asarray(mesh.texcoords[0], float).reshape(len(corners) * 3, -1)[index][..., :2]
        ((picture,),) = read.materials[mesh.material_index]["TEXTURES"].values()
        yield mesh.name, corners, uv, path.parent / picture


Reader = Callable[[Path, Scene], Iterator[Shown]]
READERS: dict[str, Reader] = {
    "gazebo": gazebo, "glb": glb, "usd": usd, "mujoco": mujoco, "urdf": urdf, "tiles3d": tiles3d,
    "carla": carla,
}  # fmt: skip


def survey_error(folder: Path, scene: Scene, name: str) -> float:
    """Metres between a corner of the synthetic scene's last house, as surveyed and as read from a format."""
    about = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))
    x, y = synthetic.HOUSE
    surveyed = scene.tiles[-1].frame.to_crs((x, y, 4.5))  # of the roof
    shown = np.concatenate([one.corners.reshape(-1, 3) for one in READERS[name](folder, scene)])
    found = (shown + about["world_origin_m"]) / about["unit_m"]
    return float(np.linalg.norm(found - surveyed, axis=1).min())
