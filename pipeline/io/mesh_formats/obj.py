"""Wavefront OBJ and MTL: z-up, as every simulator takes OBJ raw.

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
CHUNK = 100_000  # rows formatted at once


def write(path: Path, surface: Textured, names: PageNames) -> None:
    """Write a textured mesh, one `usemtl` a page, and its class's materials beside it.

    Args:
        path: of the .obj.
        surface: local metres, z up; its texture coordinates have their origin at the lower left, as OBJ's.
        names: names of materials and images; the material file is called by the class.
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
            here = mesh.page == page
            v, vt = mesh.faces[here] + 1, corner_uv[here] + 1
            _rows(file, "f %d/%d/%d %d/%d/%d %d/%d/%d\n", np.stack([v, vt, v], axis=2))


def write_plain(path: Path, mesh: Mesh) -> None:
    """Write a mesh without material, for collisions; with normals, as DART's mesh shape ignores one without."""
    with open(path, "w", encoding="ascii") as file:
        _rows(file, "v %.4f %.4f %.4f\n", mesh.vertices)
        _rows(file, "vn %.3f %.3f %.3f\n", vertex_normals(mesh))
        _rows(file, "f %d//%d %d//%d %d//%d\n", np.repeat(mesh.faces + 1, 2, axis=1))


def _write_materials(path: Path, names: PageNames) -> None:
    """Write matt materials of the pages that are used."""
    lines = [
        f"newmtl {names.materials[page]}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\nmap_Kd {names.images[page]}\n"
        for page in names.used
    ]
    path.write_text("\n".join(lines), encoding="ascii")


def _rows(file: TextIO, row: str, values: npt.NDArray[Any]) -> None:
    """Format `values` (N, ...) with `row`, many at once: Python's `%` runs in C, a loop over rows doesn't."""
    for start in range(0, len(values), CHUNK):
        part = values[start : start + CHUNK]
        file.write(row * len(part) % tuple(part.ravel().tolist()))
