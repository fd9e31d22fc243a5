"""MuJoCo (MJCF): ground as a height field, walls as boxes, poles and trunks as cylinders, everything else visual only.

Worlds of robots' maps: slabs and furniture are exactly the boxes that they consist of, so that what their occupancy
maps call free is free, other surfaces are finer boxes; floors above another floor are thin prisms. What is dropped
comes to rest on the slightly sloping floors of noisy maps: the ground resists rolling, and contacts don't slip.

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
from scan2sim.pipeline.core.types import F64, Bools, Mesh
from scan2sim.pipeline.geometry import box_decomposition
from scan2sim.pipeline.geometry.cylinders import Cylinder
from scan2sim.pipeline.geometry.fitted_boxes import Box
from scan2sim.pipeline.geometry.rectilinear_solids import split_boxes
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
FINE_BOX_CELL_M = 0.1
"""Horizontal cell size and height step of that of robots' maps: their occupancy maps are exact to 5 cm."""
MIN_HEADROOM_M = 1.0
"""Distance between two grounds above each other from which the upper one is a floor of its own."""
ROLLING_FRICTION_M = 0.003
"""Rolling resistance of the ground: 2 to 3 % of the weight for tyres with a radius of 10 to 15 cm, as on carpet."""
IMPEDANCE_RATIO = 10
"""Frictional to normal impedance of contacts: with MuJoCo's default of 1, bodies creep down the slightest slope."""
SMOOTH_FRICTION = 0.2
"""Friction of walls and furniture, whatever touches them: tyres would climb them, and boxes stay on their edges."""
FLOOR_THICKNESS_M, FLOOR_MIN_RISE_M = 0.1, 0.2
"""Thickness of floors above another one, and the least height of their triangles above the height field."""
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
        shapes = solids(tile.solid(), tile.friction)
        grounds = list(ground.geoms(tile, tile_folder))
        assets += [asset for asset, _ in grounds]
        geoms = [geom for _, geom in (*visuals, *grounds)] + [*_walls(shapes, exact=scene.robot_map is not None)]
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
    option = f'  <option cone="elliptic" impratio="{IMPEDANCE_RATIO}"/>\n' if scene.robot_map else ""
    sky = 'builtin="gradient" rgb1="0.7 0.8 0.9" rgb2="0.4 0.5 0.6"'
    if scene.sky:
        sky = f'builtin="flat" rgb1="{sdf.unit_colour(scene.sky)}"'
    return f"""<mujoco model="{scene.name}">
  <compiler angle="radian" meshdir="{FOLDER}" texturedir="{FOLDER}"/>
{option}  <size nuser_geom="1"/>
  <statistic center="{sdf.numbers((low + high) / 2)}" extent="{np.linalg.norm(high - low) / 2:.3f}"/>
  <visual>
    <headlight ambient="0.7 0.7 0.7" diffuse="0.3 0.3 0.3" specular="0 0 0"/>
    <map znear="0.001" zfar="20"/>
    <global offwidth="1920" offheight="1080"/>
  </visual>
  <custom>
{georeference}  </custom>
  <asset>
    <texture name="sky" type="skybox" {sky} width="64" height="384"/>
{"".join(assets)}  </asset>
  <worldbody>
{"".join(bodies)}  </worldbody>
{robot}</mujoco>
"""


MIN_TRIANGLES = 2
"""Least number of triangles of a visual mesh: MuJoCo requires four vertices."""


def _visuals(
    tile: SceneTile, folder: Path, params: SceneParams, triangles: dict[str, int]
) -> Iterator[tuple[str, str]]:
    """Write the visual meshes; yields assets and geom of each, and adds their triangle counts to `triangles`."""
    for part in world_formats.write_single_material(folder, tile, params.model_copy(update={"pages": "png"})):
        if part.triangles < MIN_TRIANGLES:
            (folder / f"{part.name}.obj").unlink(missing_ok=True)
            continue
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
    """Ground of all tiles: height fields with nodes on multiples of `HEIGHT_FIELD_CELL_M` in scene coordinates.

    Of floors above each other in a robot's map the lowest is the height field, the others are prisms.
    """

    def __init__(self, scene: Scene) -> None:
        import open3d as o3d

        self._robot_map = scene.robot_map is not None
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

    def geoms(self, tile: SceneTile, folder: Path) -> Iterator[tuple[str, str]]:
        """Write a tile's height field; yields assets and geoms of it and of upper floors: none without ground."""
        ground = self._ground_meshes(tile)
        if not ground:
            return
        shift = np.asarray(tile.offset)
        vertices = np.concatenate([mesh.vertices for mesh in ground]) + shift
        low = np.floor(vertices.min(axis=0) / HEIGHT_FIELD_CELL_M)[:2] * HEIGHT_FIELD_CELL_M
        high = np.ceil(vertices.max(axis=0) / HEIGHT_FIELD_CELL_M)[:2] * HEIGHT_FIELD_CELL_M
        count = np.rint((high - low) / HEIGHT_FIELD_CELL_M).astype(int) + 1
        x, y = (low[k] + HEIGHT_FIELD_CELL_M * np.arange(count[k]) for k in (0, 1))
        heights, stacked = self._heights(x, y)
        heights -= shift[2]
        bottom, elevation_range = heights.min(), max(np.ptp(heights), 0.001)
        with open(folder / "heights.hf", "wb") as file:
            np.array(heights.shape, np.int32).tofile(file)
            heights.astype(np.float32).tofile(file)
        half = (high - low) / 2
        middle = (low + high) / 2 - shift[:2]
        name = f"{tile.name}/ground"
        rolling = f'{ROLLING_FRICTION_M}" condim="6"' if self._robot_map else '0.0001"'
        about = f'group="3" friction="{tile.friction:g} 0.005 {rolling} rgba="0.5 0.5 0.5 1"'
        yield (
            f"""    <hfield name="{name}" file="{tile.name}/heights.hf"
      size="{sdf.numbers((half[0], half[1], elevation_range, GROUND_THICKNESS_M))}"/>
""",
            f"""      <geom name="{name}" type="hfield" hfield="{name}" pos="{sdf.numbers((*middle, bottom))}"
        {about}/>
""",
        )
        if stacked.any():
            corners = np.concatenate([mesh.corners for mesh in ground]).astype(np.float64)
            for i, prism in enumerate(_prisms(corners[_rise(corners, low - shift[:2], heights) > FLOOR_MIN_RISE_M])):
                yield (
                    f'    <mesh name="{name}_{i}" vertex="{sdf.numbers(prism.ravel())}"/>\n',
                    f'      <geom type="mesh" mesh="{name}_{i}" {about}/>\n',
                )

    def _heights(self, x: F64, y: F64) -> tuple[F64, Bools]:
        """Heights (rows, columns), y growing with the row, and whether another floor is above.

        Nodes without ground get the height of the nearest with ground.
        """
        from scipy import ndimage

        grid_x, grid_y = np.meshgrid(x, y)
        found = self._ground_heights(grid_x, grid_y, from_above=True)
        stacked = np.zeros(found.shape, bool)
        if self._robot_map:
            lowest = self._ground_heights(grid_x, grid_y, from_above=False)
            with np.errstate(invalid="ignore"):
                stacked = found - lowest > MIN_HEADROOM_M
            found = np.where(stacked, lowest, found)
        _, nearest = ndimage.distance_transform_edt(~np.isfinite(found), return_indices=True)
        return np.asarray(found[tuple(nearest)]), stacked

    def _ground_heights(self, x: F64, y: F64, *, from_above: bool) -> F64:
        """Heights of the highest or the lowest ground at positions of any shape; infinite without ground."""
        import open3d as o3d

        sign, far = (1.0, 10_000.0) if from_above else (-1.0, 10_000.0)
        rays = np.zeros((*x.shape, 6), np.float32)
        rays[..., 0], rays[..., 1], rays[..., 2], rays[..., 5] = x, y, sign * far, -sign
        distance = self._rays.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy().astype(np.float64)
        return np.asarray(sign * (far - distance), np.float64)


def _rise(corners: F64, low: F64, heights: F64) -> F64:
    """(F,) height of triangles (F, 3, 3) above a height field (rows, columns) whose first node is at `low` (2,)."""
    centre = corners.mean(axis=1)
    inner = np.concatenate([centre[:, None], (corners + centre[:, None]) / 2], axis=1)
    node = np.rint((inner[..., :2] - low) / HEIGHT_FIELD_CELL_M).astype(np.int64)
    row, column = (node[..., 1 - k].clip(0, heights.shape[k] - 1) for k in (0, 1))
    return np.asarray((inner[..., 2] - heights[row, column]).max(axis=1))


def _prisms(corners: F64) -> Iterator[F64]:
    """(6, 3) corners of a prism below each triangle (F, 3, 3); slivers, which have no volume, are left out."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    for triangle in corners[area > 0.001 * edges]:
        yield np.concatenate([triangle, triangle - [0, 0, FLOOR_THICKNESS_M]])


def _walls(solids: Iterable[Solid], *, exact: bool) -> Iterator[str]:
    """Geoms of all collision shapes other than ground, as boxes and cylinders; `exact`: boxes as they are."""
    for solid in solids:
        shape, friction = solid.shape, f'group="3" friction="{solid.friction:g} 0.005 0.0001"'
        if isinstance(shape, Cylinder):
            yield (
                f'      <geom type="cylinder" pos="{sdf.numbers(shape.centre)}" zaxis="{sdf.numbers(shape.axis)}" '
                f'size="{shape.radius:.4f} {shape.length / 2:.4f}" {friction} rgba="0.6 0.6 0.6 1"/>\n'
            )
        elif not _is_ground(solid):
            upright, rest = split_boxes(shape) if exact else ([], shape)
            sizes = (FINE_BOX_CELL_M, FINE_BOX_CELL_M) if exact else (WALL_BOX_CELL_M, box_decomposition.HEIGHT_STEP_M)
            others = zip(*box_decomposition.boxes(rest.corners, *sizes), strict=True)
            if exact:
                friction = f'group="3" friction="{SMOOTH_FRICTION} 0.005 0.0001" priority="1"'
            for box in (*upright, *(Box(0.0, low, high) for low, high in others)):
                yield _box(box, friction)


def _box(box: Box, attributes: str) -> str:
    """Geom of an upright box."""
    c, s = np.cos(box.heading), np.sin(box.heading)
    x, y, z = (box.low + box.high) / 2
    turned = f'euler="0 0 {box.heading:.6f}" ' if box.heading else ""
    return (
        f'      <geom type="box" pos="{sdf.numbers((c * x - s * y, s * x + c * y, z))}" {turned}'
        f'size="{sdf.numbers((box.high - box.low) / 2)}" {attributes} rgba="0.7 0.5 0.4 1"/>\n'
    )


def _is_ground(solid: Solid) -> bool:
    return bool(group_of()[solid.code] == 0)
