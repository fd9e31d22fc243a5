"""URDF world for PyBullet: one link per class, for its segmentation camera; collision by concave meshes and cylinders.

Layout: `<name>.urdf`, and for each tile `urdf/<tile>/` with an OBJ for each class and texture page, the pages, and
`collision_<class>.obj`. Load it with `useFixedBase=True`; links are named `<tile>/<class>/<LAS code>`. The collision
shapes are in the link of the first class: PyBullet would draw them in a link without visuals.
"""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.geometry.cylinders import Cylinder
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.world_formats import SceneParams, SingleMaterialMesh
from scan2sim.pipeline.io.worlds import sdf
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile
from scan2sim.pipeline.simulation.collision_shapes import Solid

FOLDER = "urdf"
STATIC = '<inertial><mass value="0"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>'


def write(scene: Scene, folder: Path, params: SceneParams, report: Report) -> dict[str, int]:
    """Write the world as a URDF robot, and its meshes."""
    triangles: dict[str, int] = {}
    links = [f'  <link name="world">\n    {STATIC}\n  </link>\n']
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        tile_folder = folder / FOLDER / tile.name
        make_folder(tile_folder)
        visuals: dict[tuple[str, int], list[SingleMaterialMesh]] = {}
        for part in world_formats.write_single_material(tile_folder, tile, params):
            visuals.setdefault((part.label, part.code), []).append(part)
            triangles[f"{FOLDER}/{tile.name}/{part.name}.obj"] = part.triangles
        solids, solid_triangles = world_formats.write_solids(tile_folder, tile)
        triangles |= {f"{FOLDER}/{tile.name}/{file}": count for file, count in solid_triangles.items()}
        collision = "".join([_friction(tile), *(_collision(tile, one) for one in solids)])
        links.append(_link(tile.name, "") + _joint("world", tile.name, sdf.numbers(tile.offset)))
        for (label, code), parts in visuals.items():
            name = f"{tile.name}/{label}/{code}"
            content = collision + "".join(_visual(tile, part) for part in parts)
            links.append(_link(name, content) + _joint(tile.name, name, "0 0 0"))
            collision = ""
    text = f'<?xml version="1.0"?>\n<robot name="{scene.name}">\n{"".join(links)}</robot>\n'
    (folder / f"{scene.name}.urdf").write_text(text, encoding="ascii")
    return triangles


def _link(name: str, content: str) -> str:
    return f'  <link name="{name}">\n    {STATIC}\n{content}  </link>\n'


def _joint(parent: str, child: str, offset: str) -> str:
    return f"""  <joint name="{child}/place" type="fixed">
    <parent link="{parent}"/>
    <child link="{child}"/>
    <origin xyz="{offset}" rpy="0 0 0"/>
  </joint>
"""


def _visual(tile: SceneTile, part: SingleMaterialMesh) -> str:
    return f"""    <visual name="{part.name}">
      <geometry><mesh filename="{FOLDER}/{tile.name}/{part.name}.obj"/></geometry>
    </visual>
"""


def _friction(tile: SceneTile) -> str:
    """Friction, which in PyBullet applies to a whole link: that of the roads."""
    return f'    <contact><lateral_friction value="{tile.friction:g}"/></contact>\n'


def _collision(tile: SceneTile, solid: Solid) -> str:
    shape = solid.shape
    if isinstance(shape, Cylinder):
        return f"""    <collision name="{solid.name}">
      <origin xyz="{sdf.numbers(shape.centre)}" rpy="{sdf.numbers(shape.angles)}"/>
      <geometry><cylinder radius="{shape.radius:.4f}" length="{shape.length:.4f}"/></geometry>
    </collision>
"""
    return f"""    <collision name="{solid.name}" concave="yes">
      <geometry><mesh filename="{FOLDER}/{tile.name}/collision_{solid.name}.obj"/></geometry>
    </collision>
"""
