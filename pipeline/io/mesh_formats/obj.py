"""Wavefront OBJ and MTL writer: z up, as simulators read OBJ without converting axes.

https://www.loc.gov/preservation/digital/formats/fdd/fdd000507.shtml
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TextIO

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io.mesh_formats import PageNames
from scan2sim.pipeline.io.worlds.textured_mesh import Textured, unique_uv, vertex_normals

SUFFIX = ".obj"
ROWS_PER_FORMAT = 100_000  # rows formatted at once


def write(path: Path, surface: Textured, names: PageNames) -> None:
    """Write a textured mesh with one `usemtl` per page, and the materials of its class beside it.

    Args:
        path: the .obj file.
        surface: local metres, z up; texture coordinates with the origin at the lower left, as in OBJ.
        names: names of materials and images; the material file is named after the class.
    """
    mtl = path.with_name(f"{names.group}.mtl")
    _write_materials(mtl, names)
    mesh = surface.mesh
    assert mesh.uv is not None and mesh.page is not None
    uv, corner_uv = unique_uv(mesh.uv)
    with open(path, "w", encoding="ascii") as file:
        file.write(f"mtllib {mtl.name}\n")
        _rows(file, "v %.4f %.4f %.4f\n", mesh.vertices)
        _rows(file, "vt %.6f %.6f\n", uv)
        _rows(file, "vn %.3f %.3f %.3f\n", surface.normal)
        for page in surface.used_pages:
            file.write(f"usemtl {names.materials[page]}\n")
            on_page = mesh.page == page
            v, vt = mesh.faces[on_page] + 1, corner_uv[on_page] + 1
            _rows(file, "f %d/%d/%d %d/%d/%d %d/%d/%d\n", np.stack([v, vt, v], axis=2))


def write_plain(path: Path, mesh: Mesh) -> None:
    """Write a collision mesh, without material; with normals, as DART ignores meshes without them."""
    with open(path, "w", encoding="ascii") as file:
        _rows(file, "v %.4f %.4f %.4f\n", mesh.vertices)
        _rows(file, "vn %.3f %.3f %.3f\n", vertex_normals(mesh))
        _rows(file, "f %d//%d %d//%d %d//%d\n", np.repeat(mesh.faces + 1, 2, axis=1))


def _write_materials(path: Path, names: PageNames) -> None:
    """Write matt materials for the used pages.

    With the roughness `Pr`: without it, Gazebo takes 0, a mirror, for which its renderer warns of NaNs in the shader.
    """
    matt = "Ka 1 1 1\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\nPr 1\nPm 0\n"
    lines = [f"newmtl {names.materials[page]}\n{matt}map_Kd {names.images[page]}\n" for page in names.used]
    path.write_text("\n".join(lines), encoding="ascii")


def _rows(file: TextIO, row: str, values: npt.NDArray[Any]) -> None:
    """Write `values` (N, ...) with the format `row`, many rows per `%`, which is faster than a loop over rows."""
    for start in range(0, len(values), ROWS_PER_FORMAT):
        part = values[start : start + ROWS_PER_FORMAT]
        file.write(row * len(part) % tuple(part.ravel().tolist()))
