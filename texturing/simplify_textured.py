"""Simplification of textured meshes: decimated, unwrapped again, and the texture transferred from the original mesh.

Charts of street meshes have a few triangles each, so their borders can't be kept. The surface is decimated as a whole,
and each texel of the new pages takes colour and mask from the nearest point of the original surface, or the mean of
several points where texels become wider. Edges on the borders of tiles are kept.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, I64, U8, Bools, Frame, Mesh
from scan2sim.pipeline.io.worlds import scene as scenes
from scan2sim.pipeline.io.worlds.scene import Scene, Surface
from scan2sim.pipeline.io.worlds.textured_mesh import save_reflectance
from scan2sim.texturing.texture_page import Page

if TYPE_CHECKING:
    from scan2sim.pipeline.io.worlds.textured_mesh import Textured

MIN_TRIANGLES_PER_CLASS = 4
MAX_UNWRAP_ATTEMPTS = 4
"""Attempts to find a texel size that meets the texel budget."""
GUTTER_TEXELS, PADDING_TEXELS = 2, 16
"""Texels between charts, and texels by which colours are extended beyond charts."""
UVATLAS_MAX_TRIANGLES = 5000
"""Triangles up to which UVAtlas, which makes fewer charts, is worth its time: on small pages gutters dominate."""
INITIAL_UTILISATION = {"uvatlas": 0.9, "xatlas": 0.5}
"""Share of a page that charts are expected to cover, for the first attempt."""
MAX_SUPERSAMPLING = 4
"""Largest number of samples per texel in each direction."""
WELD_DISTANCE_M = 1e-3
"""Distance in metres within which vertices are the same."""
CHUNK_POINTS = 2_000_000
"""Points whose colours are looked up at once."""


class Share(NamedTuple):
    """Shares of the triangles and texels that are kept."""

    triangles: float
    texels: float


def simplified_scene(scene: Scene, triangles: int | None, texels: float | None, folder: Path, report: Report) -> Scene:
    """Scene whose tiles are simplified to a budget of triangles and texels; tiles within the budget are unchanged.

    Args:
        scene: scene to be simplified.
        triangles: maximum number of triangles of a tile's surfaces together (exceeded where its borders alone need
            more); None: no limit.
        texels: maximum number of texels of a tile's pages together; None: no limit.
        folder: folder for the new scene.
        report: progress callback.
    """
    world = folder / "world"
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        shapes = tile.textured()
        share = Share(
            min(1.0, (triangles or np.inf) / sum(map(len, shapes.values()))),
            min(1.0, (texels or np.inf) / sum(map(texel_count, shapes.values()))),
        )
        sources = {group: tile.folder / group for group in shapes}
        photos = {group: shape.photo for group, shape in shapes.items() if shape.photo is not None}
        for group, shape in shapes.items() if min(share) < 1 else ():
            sources[group] = folder / tile.name / group
            small = simplify_group(group, shape, tile.folder / group, share, None, sources[group])
            if group in photos:
                photos[group] = photos[group][_nearest(shape.mesh, small)]
        scenes.save_tile(
            world, tile.name, sources, tile.folder / scenes.COLLISION_FILE, tile.extra_files, tile.friction,
            views=tile.views(), photos=photos,
        )  # fmt: skip
    scenes.write_scene_file(world, scene.name, scene.frame, [tile.name for tile in scene.tiles])
    return replace(scenes.read_scene(world), dome=scene.dome)


def simplify_group(group: str, shape: Textured, source: Path, share: Share, borders: F64 | None, out: Path) -> Mesh:
    """Write a simplified surface group as a textured mesh; returns the mesh.

    Args:
        group: name of the group.
        shape: textured mesh of the group.
        source: folder that it was read from.
        share: shares of triangles and texels to keep.
        borders: (K, 3) vertices, local metres, that other tiles have, too: open edges between them are kept.
            None: all open edges are kept.
        out: folder to be created.
    """
    from scan2sim.texturing.texture_layout import UnwrapParams, unwrapped

    out.mkdir(parents=True)
    frame, parts = shape.mesh.frame, scenes.by_class(group, shape)
    small = _joined(frame, [(part, _decimated(part.shape.mesh, share.triangles, borders)) for part in parts])
    budget = share.texels * texel_count(shape)
    backend: Literal["xatlas", "uvatlas"] = "uvatlas" if len(small) <= UVATLAS_MAX_TRIANGLES else "xatlas"
    texel = float(np.sqrt(small.face_area.sum(dtype=np.float64) / (INITIAL_UTILISATION[backend] * budget)))
    for _ in range(MAX_UNWRAP_ATTEMPTS):  # the utilisation of the pages is known only after unwrapping
        params = UnwrapParams(backend=backend, texel=float(np.clip(texel, 0.0005, 10)), gutter=GUTTER_TEXELS)
        layout = unwrapped(small, params, silent)
        count = sum(page["width"] * page["height"] for page in layout.pages)
        if count <= budget:
            break
        texel *= 1.05 * np.sqrt(count / budget)
    flat = layout.applied_to(small)
    flat.save(out / "mesh.npz")
    if shape.reflectance is not None:
        save_reflectance(out, shape.reflectance[_nearest_vertex(shape.mesh, flat)])
    _paint(flat, layout.pages, source, out, int(np.clip(np.rint(share.texels**-0.5), 1, MAX_SUPERSAMPLING)))
    return flat


def _nearest(mesh: Mesh, small: Mesh) -> I64:
    """(F,) for each face of `small`, the face of `mesh` with the nearest centroid."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(mesh.corners.mean(axis=1)).query(small.corners.mean(axis=1))[1], np.int64)


def _nearest_vertex(mesh: Mesh, small: Mesh) -> I64:
    """(V,) for each vertex of `small`, the nearest vertex of `mesh`."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(mesh.vertices).query(small.vertices)[1], np.int64)


def _decimated(mesh: Mesh, share: float, borders: F64 | None) -> Mesh:
    from scan2sim.pipeline.tiling.borders.open_edges import decimate_keeping_borders

    return decimate_keeping_borders(
        mesh, max(MIN_TRIANGLES_PER_CLASS, int(share * len(mesh))), _on_borders(mesh, borders)
    )


def _on_borders(mesh: Mesh, borders: F64 | None) -> Bools:
    """(V,) vertices at one of the border points (K, 3); None: all."""
    from scipy.spatial import cKDTree

    if borders is None:
        return np.ones(len(mesh.vertices), bool)
    if not len(borders):
        return np.zeros(len(mesh.vertices), bool)
    return np.isfinite(cKDTree(borders).query(mesh.vertices, distance_upper_bound=WELD_DISTANCE_M)[0])


def _joined(frame: Frame, parts: list[tuple[Surface, Mesh]]) -> Mesh:
    """Several meshes joined into one, with the class of each face."""
    first = np.cumsum([0, *(len(mesh.vertices) for _, mesh in parts)])
    own = {surface.group for surface, _ in parts}
    codes = [0 if surface.name in own else surface.code for surface, _ in parts]
    return Mesh(
        frame,
        np.concatenate([mesh.vertices for _, mesh in parts]),
        np.concatenate([mesh.faces + n for (_, mesh), n in zip(parts, first, strict=False)]).astype(np.int32),
        classification=np.repeat(np.array(codes, np.uint8), [len(mesh) for _, mesh in parts]),
    )


def _paint(mesh: Mesh, pages: list[dict[str, int]], source: Path, out: Path, samples: int) -> None:
    """Write a mesh's `pages` with texture from the textured mesh in `source`, with samples x samples per texel."""
    from scan2sim.pipeline.camera import renderer
    from scan2sim.texturing import texel_map as texels
    from scan2sim.texturing.bake.page_writer import PageWriter
    from scan2sim.texturing.inpainting import hole_filling

    assert mesh.uv is not None and mesh.page is not None
    original = renderer.Renderer([renderer.textured(source)])
    writer = PageWriter()
    for k, size in enumerate(pages):
        faces = np.flatnonzero(mesh.page == k)
        corners = mesh.corners[faces]
        flat = texels.corners(mesh.uv[faces], samples * size["width"], samples * size["height"])
        owner = texels.owners(flat, samples * size["width"], samples * size["height"])
        rows, columns = np.nonzero(owner >= 0)
        rgb = np.zeros((*owner.shape, 3), np.uint8)
        seen = np.zeros(owner.shape, np.uint8)
        for first in range(0, len(rows), CHUNK_POINTS):
            chunk = rows[first : first + CHUNK_POINTS], columns[first : first + CHUNK_POINTS]
            rgb[chunk], seen[chunk], _ = original.nearest(hole_filling.texel_points(owner, flat, corners, *chunk))
        rgb, seen = _downsampled(rgb, seen, samples)
        hole_filling.pad(rgb, seen, PADDING_TEXELS)
        writer.write(out / f"page_{k}", Page(rgb, seen, owner, flat, corners))
    writer.finish()


def _downsampled(rgb: U8, seen: U8, factor: int) -> tuple[U8, U8]:
    """Page at 1/factor of its resolution: mean of the texels that have a colour, and the smallest of their marks."""
    height, width = (side // factor for side in seen.shape)
    marks = seen.reshape(height, factor, width, factor)
    count = (marks > 0).sum(axis=(1, 3))
    total = rgb.reshape(height, factor, width, factor, 3).sum(axis=(1, 3), dtype=np.uint32)
    mean = (total + count[..., None] // 2) // np.maximum(count, 1)[..., None]
    least = np.where(marks > 0, marks, 255).min(axis=(1, 3))
    return mean.astype(np.uint8), np.where(count > 0, least, 0).astype(np.uint8)


def texel_count(shape: Textured) -> int:
    """Number of texels of all pages that the faces of a textured mesh use."""
    from scan2sim.pipeline.io.images import image

    return sum(int(np.prod(image.size_of(shape.pages[page]))) for page in shape.used_pages)
