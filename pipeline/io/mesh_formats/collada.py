"""Collada 1.4.1 writer, with pycollada: Z_UP, metres.

Gazebo's loader silently drops triangles whose semantics share an offset, so each of vertex, normal
and texture coordinate gets its own (0, 1, 2). It ignores `up_axis` but honours `meter`; Blender
honours both.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.io.mesh_formats import PageNames
from scan2sim.pipeline.io.worlds.textured_mesh import Textured, unique_uv

SUFFIX = ".dae"
CREATION_TIME = datetime(2000, 1, 1)  # constant, so that the same mesh gives the same bytes


def write(path: Path, surface: Textured, names: PageNames) -> None:
    """Write a textured mesh with one geometry and one material per page.

    Args:
        path: the .dae file.
        surface: local metres, z up; written with seven significant digits (0.1 mm within 1 km).
        names: names of materials and images.
    """
    import collada
    from collada import asset, scene, source

    document = collada.Collada()
    document.assetInfo.created = document.assetInfo.modified = CREATION_TIME
    document.assetInfo.upaxis = asset.UP_AXIS.Z_UP
    document.assetInfo.unitname, document.assetInfo.unitmeter = "meter", 1.0
    nodes = []
    for page in surface.used_pages:
        name = names.materials[page]
        part = surface.on_page(page)
        assert part.mesh.uv is not None
        uv, corner_uv = unique_uv(part.mesh.uv)
        geometry = collada.geometry.Geometry(
            document,
            f"{name}-mesh",
            name,
            [
                source.FloatSource(f"{name}-v", part.mesh.vertices.ravel(), ("X", "Y", "Z")),
                source.FloatSource(f"{name}-n", part.normal.ravel(), ("X", "Y", "Z")),
                source.FloatSource(f"{name}-t", uv.ravel(), ("S", "T")),
            ],
        )
        inputs = source.InputList()
        inputs.addInput(0, "VERTEX", f"#{name}-v")
        inputs.addInput(1, "NORMAL", f"#{name}-n")
        inputs.addInput(2, "TEXCOORD", f"#{name}-t", set="0")
        index = np.stack([part.mesh.faces, part.mesh.faces, corner_uv], axis=2)
        geometry.primitives.append(geometry.createTriangleSet(index.ravel(), inputs, name))
        document.geometries.append(geometry)
        material = _material(document, name, names.images[page])
        bound = scene.MaterialNode(name, material, inputs=[("UV", "TEXCOORD", "0")])
        nodes.append(scene.Node(name, children=[scene.GeometryNode(geometry, [bound])]))
    document.scenes.append(scene.Scene("scene", nodes))
    document.scene = document.scenes[0]
    document.write(str(path))


def _material(document: Any, name: str, texture: str) -> Any:
    from collada import material

    image = material.CImage(f"{name}-image", texture)
    surface = material.Surface(f"{name}-surface", image)
    sampler = material.Sampler2D(f"{name}-sampler", surface)
    texture_map = material.Map(sampler, "UV")
    effect = material.Effect(
        f"{name}-effect", [surface, sampler], "lambert",
        ambient=(1.0, 1.0, 1.0, 1.0), diffuse=texture_map, emission=(0.0, 0.0, 0.0, 1.0),
    )  # fmt: skip
    result = material.Material(f"{name}-material", name, effect)
    document.images.append(image)
    document.effects.append(effect)
    document.materials.append(result)
    return result
