"""A textured mesh made smaller: fewer triangles, unwrapped anew, painted from the one that it is made of.

Charts of street meshes are of a few triangles each, whose borders couldn't be kept: so the surface is simplified as a
whole, and each texel of the new pages takes its colour, and where that is from, from the nearest place of the old
surface. Edges where the mesh ends stay, so tiles still meet.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2sim.pipeline.io import scene as scenes
from scan2sim.pipeline.io.scene import Scene, SceneTile, Surface
from scan2sim.pipeline.step import Report, silent
from scan2sim.pipeline.types import Frame, Mesh

if TYPE_CHECKING:
    from scan2sim.pipeline.io.textured import Textured

LEAST = 4
"""Triangles that each class keeps."""
TRIES = 4
"""At the width of texels that keeps to the budget."""
GUTTER, PADDING = 2, 16
"""Texels between charts, and that colours are carried beyond them."""


def reduced(scene: Scene, triangles: int | None, texels: float | None, folder: Path, report: Report) -> Scene:
    """A scene whose tiles have at most about so many triangles and texels each; smaller ones stay as they are.

    Args:
        scene: to be made smaller.
        triangles: that a tile's surfaces may have together; more where its borders alone need them.
        texels: of a tile's pages together.
        folder: where what is made is kept.
        report: progress.
    """
    world = folder / "world"
    for i, tile in enumerate(scene.tiles):
        report(i / len(scene.tiles), tile.name)
        shapes = tile.textured()
        share_t = min(1.0, (triangles or np.inf) / sum(map(len, shapes.values())))
        share_p = min(1.0, (texels or np.inf) / sum(map(_texels, shapes.values())))
        sources = {}
        for group, shape in shapes.items():
            sources[group] = tile.folder / group
            if min(share_t, share_p) < 1:
                sources[group] = folder / tile.name / group
                _reduce(tile, group, shape, share_t, share_p, sources[group])
        scenes.keep(world, tile.name, sources, tile.folder / scenes.SOLID, tile.lists, tile.friction)
    scenes.describe(world, scene.name, scene.frame, [tile.name for tile in scene.tiles])
    return scenes.read_scene(world)


def _reduce(tile: SceneTile, group: str, shape: Textured, triangles: float, texels: float, out: Path) -> None:
    """Write a group with these shares of its triangles and texels as a textured mesh."""
    from scan2sim.texturing.unwrap import UNWRAP, UTILISATION, UnwrapParams

    out.mkdir(parents=True)
    small = _joined(tile.frame, [(s, _simplified(s, triangles)) for s in scenes.by_class(group, shape)])
    small.save(out / "small.npz")
    most = texels * _texels(shape)
    wide = float(np.sqrt(small.face_area.sum(dtype=np.float64) / (UTILISATION * most)))
    for _ in range(TRIES):  # how well charts fill pages shows afterwards
        params = UnwrapParams(backend="xatlas", texel=float(np.clip(wide, 0.0005, 10)), gutter=GUTTER)
        flat = Mesh.load(UNWRAP.run({"mesh": out / "small.npz"}, params, out, silent).files["mesh"])
        pages = json.loads((out / "pages.json").read_text(encoding="utf-8"))
        found = sum(page["width"] * page["height"] for page in pages)
        if found <= most:
            break
        wide *= 1.05 * np.sqrt(found / most)
    _paint(flat, pages, tile.folder / group, out)


def _simplified(surface: Surface, share: float) -> Mesh:
    from scan2sim.pipeline.decimation import simplify

    mesh = surface.shape.mesh
    return simplify(mesh, max(LEAST, int(share * len(mesh))))


def _joined(frame: Frame, parts: list[tuple[Surface, Mesh]]) -> Mesh:
    """One mesh of several, which says of each face its class."""
    first = np.cumsum([0, *(len(mesh.vertices) for _, mesh in parts)])
    own = {surface.group for surface, _ in parts}
    codes = [0 if surface.name in own else surface.code for surface, _ in parts]
    return Mesh(
        frame,
        np.concatenate([mesh.vertices for _, mesh in parts]),
        np.concatenate([mesh.faces + n for (_, mesh), n in zip(parts, first, strict=False)]).astype(np.int32),
        classification=np.repeat(np.array(codes, np.uint8), [len(mesh) for _, mesh in parts]),
    )


def _paint(mesh: Mesh, pages: list[dict[str, int]], source: Path, out: Path) -> None:
    """Write a mesh's pages, of these sizes, from the textured mesh in `source`."""
    from scan2sim.pipeline import render
    from scan2sim.texturing import fill, texels
    from scan2sim.texturing.writer import Writer

    assert mesh.uv is not None and mesh.page is not None
    old = render.Renderer([render.textured(source)])
    writer = Writer()
    for k, size in enumerate(pages):
        faces = np.flatnonzero(mesh.page == k)
        flat = texels.corners(mesh.uv[faces], size["width"], size["height"])
        owner = texels.owners(flat, size["width"], size["height"])
        rows, columns = np.nonzero(owner >= 0)
        rgb = np.zeros((*owner.shape, 3), np.uint8)
        seen = np.zeros(owner.shape, np.uint8)
        places = fill.texel_places(owner, flat, mesh.corners[faces], rows, columns)
        rgb[rows, columns], seen[rows, columns], _ = old.nearest(places)
        fill.pad(rgb, seen, PADDING)
        writer.write(out / f"page_{k}", fill.Page(rgb, seen, owner, flat, mesh.corners[faces]))
    writer.finish()


def _texels(shape: Textured) -> int:
    from scan2sim.pipeline.io import image

    return sum(int(np.prod(image.size_of(shape.pages[page]))) for page in shape.used_pages)
