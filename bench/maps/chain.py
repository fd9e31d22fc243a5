"""What the benchmark uses of the product, in one place: up axis, `scan2sim run MAP`, and the world's files."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.maps.command import Missing, scan2sim
from bench.maps.inputs import BenchMap
from bench.measure import Measurement
from scan2sim.data_samples.building import FreeSpace
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import ScanError
from scan2sim.pipeline.core.types import F64, Mesh, PointCloud
from scan2sim.pipeline.geometry.upright import find_up as find_upright
from scan2sim.pipeline.io.worlds.scene import Scene, Surface, read_scene

WALL_CLASSES = ("wall", "building", "wall_or_fence")
"""Names of classes whose vertical faces are walls."""


def find_up(xyz: F64) -> F64:
    """(3,) up in the axes of a map with points (N, 3), as the product finds it.

    Raises:
        Missing: the map has no flat surfaces.
    """
    found = find_upright(xyz.astype(np.float32))
    if found is None:
        raise Missing("no flat surfaces in the map")
    return found.up


def build(one: BenchMap, out: Path) -> tuple[World, Measurement]:
    """`scan2sim run` of a map; results of earlier runs in the same folder are reused by its cache.

    Raises:
        Missing: it failed.
    """
    measured = scan2sim(out.with_suffix(".log"), "run", one.path, "--out", out)
    return World(out), measured


@dataclass(frozen=True)
class World:
    """The output folder of a run; world coordinates are those of the simulator, metres, z up."""

    run: Path

    @cached_property
    def scene(self) -> Scene:
        """The exported scene."""
        try:
            return read_scene(self.run)
        except ScanError as error:
            raise Missing(str(error)) from None

    @cached_property
    def T_world_map(self) -> F64:
        """(4, 4) map coordinates to the simulator's, from the world's metadata."""
        file = self.run / "world" / "metadata.json"
        about = json.loads(file.read_text(encoding="utf-8"))
        if "T_world_map" not in about:
            raise Missing(f"{file} has no T_world_map")
        return np.array(about["T_world_map"], np.float64).reshape(4, 4)

    def place(self, xyz: npt.ArrayLike) -> F64:
        """(N, 3) points of the map in world coordinates."""
        return np.asarray(xyz, np.float64) @ self.T_world_map[:3, :3].T + self.T_world_map[:3, 3]

    @cached_property
    def surfaces(self) -> list[tuple[Surface, Mesh]]:
        """Visual surfaces by class, with their meshes in world coordinates."""
        found = []
        for tile in self.scene.tiles:
            for surface in tile.surfaces():
                mesh = surface.shape.mesh
                found.append((surface, replace(mesh, vertices=mesh.vertices + np.asarray(tile.offset, np.float32))))
        return found

    @cached_property
    def mesh(self) -> Mesh:
        """All visual surfaces as one mesh with classes."""
        return joined([(mesh, surface.code) for surface, mesh in self.surfaces])

    @cached_property
    def walls(self) -> Mesh:
        """Vertical faces of walls and buildings."""
        codes = [CODE[name] for name in WALL_CLASSES if name in CODE]
        assert self.mesh.classification is not None
        vertical = np.abs(self.mesh.face_normal[:, 2]) < 0.7
        return self.mesh.keep(np.isin(self.mesh.classification, codes) & vertical)

    @property
    def triangles(self) -> int:
        """Number of triangles of all visual surfaces."""
        return len(self.mesh)

    def maps(self) -> list[FreeSpace]:
        """The world's occupancy maps (Nav2: YAML and PGM), that of the start first.

        Raises:
            Missing: there is none.
        """
        found = []
        navigation = self.scene.tiles[0].navigation() or {"storeys": []}
        floors = {storey["map"]: storey["floor_m"] for storey in navigation["storeys"]}
        for file in sorted((self.run / "world").glob("*.yaml")):
            about = _read_yaml(file)
            if "image" in about and "resolution" in about:
                found.append(_read_map(file, about)._replace(floor=floors.get(file.name, 0.0)))
        if not found:
            raise Missing(f"{self.run / 'world'} contains no Nav2 map (YAML with `image` and `resolution`)")
        return found

    def points(self) -> PointCloud:
        """The points that the run classified, in world coordinates.

        Raises:
            Missing: the step `split` left none.
        """
        clouds = []
        for part in ("terrain", "building", "vegetation", "rest", "ceiling", "furniture"):
            files = sorted((self.run / "steps" / "split").glob(f"*/{part}.npz"), key=os.path.getmtime)
            if files:
                clouds.append(PointCloud.load(files[-1]))
        if not clouds:
            raise Missing(f"{self.run / 'steps' / 'split'} contains no classified points")
        offset = np.asarray(self.scene.tiles[0].offset, np.float32)
        return PointCloud.join([replace(cloud, xyz=cloud.xyz + offset) for cloud in clouds if len(cloud)])


def joined(parts: list[tuple[Mesh, int]]) -> Mesh:
    """Meshes with a class each as one mesh."""
    first = np.cumsum([0] + [len(mesh.vertices) for mesh, _ in parts])
    return Mesh(
        parts[0][0].frame,
        np.concatenate([mesh.vertices for mesh, _ in parts]),
        np.concatenate([mesh.faces + np.int32(n) for (mesh, _), n in zip(parts, first, strict=False)]).astype(np.int32),
        classification=np.concatenate([np.full(len(mesh), code, np.uint8) for mesh, code in parts]),
    )


def _read_yaml(file: Path) -> dict[str, Any]:
    import yaml

    about = yaml.safe_load(file.read_text(encoding="utf-8"))
    return about if isinstance(about, dict) else {}


def _read_map(file: Path, about: dict[str, Any]) -> FreeSpace:
    """A map of nav2_map_server in mode trinary; rows of its image go down, those of `free` up."""
    import cv2

    image = cv2.imread(str(file.parent / about["image"]), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise Missing(f"{file.parent / about['image']}, the image of {file.name}, can't be read")
    occupied = image / 255 if about.get("negate") else 1 - image / 255
    x, y, yaw = about["origin"]
    if abs(yaw) > 1e-6:
        raise Missing(f"{file}: its map is rotated, which this benchmark doesn't support")
    return FreeSpace(np.array([x, y]), about["resolution"], (occupied < about.get("free_thresh", 0.25))[::-1], 0.0)
