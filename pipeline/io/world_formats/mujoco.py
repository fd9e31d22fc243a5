"""MuJoCo (MJCF): ground as a height field, walls as boxes, poles and trunks as cylinders, everything else visual only.

Layout: `<name>.xml`, and for each tile `mujoco/<tile>/` with an OBJ for each class and texture page, the pages as PNG
(MuJoCo doesn't read JPEG) and `heights.hf`. Meshes don't collide, as MuJoCo would use their convex hulls. Every visual
geom has its LAS code as `user`. Height fields of neighbouring tiles share nodes and heights at their borders.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from scan2sim.pipeline.core.classes import group_of
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F64, Mesh
from scan2sim.pipeline.geometry import box_decomposition
from scan2sim.pipeline.geometry.cylinders import Cylinder
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds import sdf
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile
from scan2sim.pipeline.simulation.collision_shapes import Solid, solids
from scan2sim.pipeline.simulation.robot import ROBOT

FOLDER = "mujoco"
HEIGHT_FIELD_CELL_M = 0.1
"""Distance between nodes of the height field."""
WALL_BOX_CELL_M = 0.2
"""Horizontal cell size of the box decomposition of walls."""
GROUND_THICKNESS_M = 2.0
"""Thickness of the ground below its lowest node."""


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the MJCF model and its files."""
    triangles: dict[str, int] = {}
    assets: list[str] = []
    bodies: list[str] = []
    ground = _Ground(scene)
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        tile_folder = folder / FOLDER / tile.name
        make_folder(tile_folder)
        visuals = list(_visuals(tile, tile_folder, params, triangles))
        assets += [asset for asset, _ in visuals]
        field_asset, field_geom = ground.field(tile, tile_folder)
        assets.append(field_asset)
        geoms = [geom for _, geom in visuals] + [field_geom, *_walls(solids(tile.solid(), tile.friction))]
        bodies.append(f'    <body name="{tile.name}" pos="{sdf.numbers(tile.offset)}">\n{"".join(geoms)}    </body>\n')
    (folder / f"{scene.name}.xml").write_text(_model(scene, assets, bodies), encoding="ascii")
    return triangles


def _model(scene: Scene, assets: list[str], bodies: list[str]) -> str:
    low = np.min([np.add(tile.offset, tile.low) for tile in scene.tiles], axis=0)
    high = np.max([np.add(tile.offset, tile.high) for tile in scene.tiles], axis=0)
    georeference_entries = {"crs": scene.frame.crs, "world_origin_m": scene.origin, "unit_m": scene.frame.unit}
    georeference = "".join(
        f"    <text name={quoteattr(name)} data={quoteattr(json.dumps(value))}/>\n"
        for name, value in georeference_entries.items()
    )
    robot = f'  <include file="{ROBOT.name}.xml"/>\n' if scene.start else ""
    return f"""<mujoco model="{scene.name}">
  <compiler angle="radian" meshdir="{FOLDER}" texturedir="{FOLDER}"/>
  <size nuser_geom="1"/>
  <statistic center="{sdf.numbers((low + high) / 2)}" extent="{np.linalg.norm(high - low) / 2:.3f}"/>
  <visual>
    <headlight ambient="0.7 0.7 0.7" diffuse="0.3 0.3 0.3" specular="0 0 0"/>
    <map znear="0.001" zfar="20"/>
    <global offwidth="1920" offheight="1080"/>
  </visual>
  <custom>
{georeference}  </custom>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.7 0.8 0.9" rgb2="0.4 0.5 0.6" width="64" height="384"/>
{"".join(assets)}  </asset>
  <worldbody>
{"".join(bodies)}  </worldbody>
{robot}</mujoco>
"""


def _visuals(
    tile: SceneTile, folder: Path, params: SceneParams, triangles: dict[str, int]
) -> Iterator[tuple[str, str]]:
    """Write the visual meshes; yields assets and geom of each, and adds their triangle counts to `triangles`."""
    for part in world_formats.write_single_material(folder, tile, params.model_copy(update={"pages": "png"})):
        name = f"{tile.name}/{part.name}"
        triangles[f"{FOLDER}/{tile.name}/{part.name}.obj"] = part.triangles
        yield (
            f"""    <texture name="{name}" type="2d" file="{tile.name}/{part.image}"/>
    <material name="{name}" texture="{name}" specular="0" shininess="0"/>
    <mesh name="{name}" file="{tile.name}/{part.name}.obj" inertia="shell"/>
""",
            f"""      <geom name="{name}" type="mesh" mesh="{name}" material="{name}" user="{part.code}"
        group="2" contype="0" conaffinity="0" mass="0"/>
""",
        )


class _Ground:
    """Heights of the ground of all tiles, at nodes on multiples of `HEIGHT_FIELD_CELL_M` in scene coordinates."""

    def __init__(self, scene: Scene) -> None:
        import open3d as o3d

        self._rays = o3d.t.geometry.RaycastingScene()
        for tile in scene.tiles:
            for mesh in self._ground_meshes(tile):
                xyz = (mesh.vertices + np.asarray(tile.offset)).astype(np.float32)
                faces = mesh.faces.astype(np.uint32)
                self._rays.add_triangles(o3d.core.Tensor.from_numpy(xyz), o3d.core.Tensor.from_numpy(faces))

    def _ground_meshes(self, tile: SceneTile) -> list[Mesh]:
        """The ground meshes of a tile, local metres."""
        found = solids(tile.solid(), tile.friction)
        return [one.shape for one in found if isinstance(one.shape, Mesh) and _is_ground(one)]

    def field(self, tile: SceneTile, folder: Path) -> tuple[str, str]:
        """Write a tile's height field; returns its asset and geom, both empty if the tile has no ground."""
        ground = self._ground_meshes(tile)
        if not ground:
            return "", ""
        shift = np.asarray(tile.offset)
        vertices = np.concatenate([mesh.vertices for mesh in ground]) + shift
        low = np.floor(vertices.min(axis=0) / HEIGHT_FIELD_CELL_M)[:2] * HEIGHT_FIELD_CELL_M
        high = np.ceil(vertices.max(axis=0) / HEIGHT_FIELD_CELL_M)[:2] * HEIGHT_FIELD_CELL_M
        count = np.rint((high - low) / HEIGHT_FIELD_CELL_M).astype(int) + 1
        x, y = (low[k] + HEIGHT_FIELD_CELL_M * np.arange(count[k]) for k in (0, 1))
        heights = self._heights(x, y) - shift[2]
        bottom, elevation_range = heights.min(), max(np.ptp(heights), 0.001)
        with open(folder / "heights.hf", "wb") as file:
            np.array(heights.shape, np.int32).tofile(file)
            heights.astype(np.float32).tofile(file)
        half = (high - low) / 2
        middle = (low + high) / 2 - shift[:2]
        name = f"{tile.name}/ground"
        return (
            f"""    <hfield name="{name}" file="{tile.name}/heights.hf"
      size="{sdf.numbers((half[0], half[1], elevation_range, GROUND_THICKNESS_M))}"/>
""",
            f"""      <geom name="{name}" type="hfield" hfield="{name}" pos="{sdf.numbers((*middle, bottom))}"
        group="3" friction="{tile.friction:g} 0.005 0.0001" rgba="0.5 0.5 0.5 1"/>
""",
        )

    def _heights(self, x: F64, y: F64) -> F64:
        """Heights (rows, columns), y growing with the row; nodes without ground get that of the nearest with ground."""
        import open3d as o3d
        from scipy import ndimage

        grid_x, grid_y = np.meshgrid(x, y)
        top = 10_000.0
        rays = np.zeros((*grid_x.shape, 6), np.float32)
        rays[..., 0], rays[..., 1], rays[..., 2], rays[..., 5] = grid_x, grid_y, top, -1
        found = top - self._rays.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy().astype(np.float64)
        _, nearest = ndimage.distance_transform_edt(~np.isfinite(found), return_indices=True)
        return np.asarray(found[tuple(nearest)])


def _walls(solids: Iterable[Solid]) -> Iterator[str]:
    """Geoms of all collision shapes other than ground, as boxes and cylinders."""
    for solid in solids:
        shape, friction = solid.shape, f'group="3" friction="{solid.friction:g} 0.005 0.0001"'
        if isinstance(shape, Cylinder):
            yield (
                f'      <geom type="cylinder" pos="{sdf.numbers(shape.centre)}" zaxis="{sdf.numbers(shape.axis)}" '
                f'size="{shape.radius:.4f} {shape.length / 2:.4f}" {friction} rgba="0.6 0.6 0.6 1"/>\n'
            )
        elif not _is_ground(solid):
            for low, high in zip(*box_decomposition.boxes(shape.corners, WALL_BOX_CELL_M), strict=True):
                yield (
                    f'      <geom type="box" pos="{sdf.numbers((low + high) / 2)}" '
                    f'size="{sdf.numbers((high - low) / 2)}" {friction} rgba="0.7 0.5 0.4 1"/>\n'
                )


def _is_ground(solid: Solid) -> bool:
    return bool(group_of()[solid.code] == 0)
