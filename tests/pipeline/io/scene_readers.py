"""What others read of an exported scene: a reader a format, by its users' own libraries."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from scan2sim.pipeline.io.scene import Scene


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
    """Of a file whose name is ASCII and without spaces."""
    assert path.as_posix().isascii() and " " not in path.name
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
    for key, *words in map(str.split, filter(None, (path.parent / rows["mtllib"][0][0]).read_text().splitlines())):
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
                yield Shown(int(visual.findtext("plugin/label", "")), corners + offset, uv, picture)


def glb(folder: Path, scene: Scene) -> Iterator[Shown]:
    import trimesh

    for tile in scene.tiles:
        read = trimesh.load_scene(folder / f"{tile.name}.glb", process=False)
        for node in read.graph.nodes_geometry:
            transform, name = read.graph[node]
            mesh = read.geometry[name]
            world = mesh.vertices @ transform[:3, :3].T + transform[:3, 3]
            corners = np.stack([world[:, 0], -world[:, 2], world[:, 1]], axis=1)[mesh.faces]
            picture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
            yield Shown(mesh.metadata["class"], corners, mesh.visual.uv[mesh.faces], picture)


READERS: dict[str, Callable[[Path, Scene], Iterator[Shown]]] = {"gazebo": gazebo, "glb": glb}
