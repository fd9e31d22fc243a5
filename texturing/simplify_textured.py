"""A textured mesh made smaller: fewer triangles, unwrapped anew, painted from the one that it is made of.

Charts of street meshes are of a few triangles each, whose borders couldn't be kept: so the surface is simplified as a
whole, and each texel of the new pages takes its colour, and where that is from, from the nearest place of the old
surface, the mean of several where texels become wider. Edges where tiles meet stay as they are.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, I64, U8, Bools, Frame, Mesh
from scan2sim.pipeline.io.worlds import scene as scenes
from scan2sim.pipeline.io.worlds.scene import Scene, Surface

if TYPE_CHECKING:
    from scan2sim.pipeline.io.worlds.textured_mesh import Textured

LEAST = 4
"""Triangles that each class keeps."""
TRIES = 4
"""At the width of texels that keeps to the budget."""
GUTTER, PADDING = 2, 16
"""Texels between charts, and that colours are carried beyond them."""
FEW = 5000
"""Triangles up to which the unwrapper with fewer charts is worth its time: on small pages all is room between them."""
FILLED = {"uvatlas": 0.9, "xatlas": 0.5}
"""Shares of a page that charts cover, to begin with."""
FINE = 4
"""Places a side, at most, whose mean a wider texel is."""
SAME = 1e-3
"""Metres within which a vertex is one of those that stay."""
CHUNK = 2_000_000
"""Places whose colours are asked for at once."""


class Share(NamedTuple):
    """What is left: shares of the triangles and of the texels."""

    triangles: float
    texels: float


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
        share = Share(
            min(1.0, (triangles or np.inf) / sum(map(len, shapes.values()))),
            min(1.0, (texels or np.inf) / sum(map(texels_of, shapes.values()))),
        )
        sources = {group: tile.folder / group for group in shapes}
        photos = {group: shape.photo for group, shape in shapes.items() if shape.photo is not None}
        for group, shape in shapes.items() if min(share) < 1 else ():
            sources[group] = folder / tile.name / group
            small = shrink(group, shape, tile.folder / group, share, None, sources[group])
            if group in photos:
                photos[group] = photos[group][_nearest(shape.mesh, small)]
        scenes.keep(
            world, tile.name, sources, tile.folder / scenes.SOLID, tile.known, tile.friction,
            views=tile.views(), photos=photos,
        )  # fmt: skip
    scenes.describe(world, scene.name, scene.frame, [tile.name for tile in scene.tiles])
    return scenes.read_scene(world)


def shrink(group: str, shape: Textured, source: Path, share: Share, borders: F64 | None, out: Path) -> Mesh:
    """Write a group with shares of its triangles and texels as a textured mesh; returns it.

    Args:
        group: its name.
        shape: the group.
        source: folder that it was read from.
        share: what is left.
        borders: (K, 3) local metres, vertices that other tiles have, too: open edges between them stay as they are.
            None: all open edges stay.
        out: a new folder.
    """
    from scan2sim.texturing.unwrap import UNWRAP, UnwrapParams

    out.mkdir(parents=True)
    frame, parts = shape.mesh.frame, scenes.by_class(group, shape)
    small = _joined(frame, [(part, _simplified(part.shape.mesh, share.triangles, borders)) for part in parts])
    small.save(out / "small.npz")
    most = share.texels * texels_of(shape)
    backend: Literal["xatlas", "uvatlas"] = "uvatlas" if len(small) <= FEW else "xatlas"
    wide = float(np.sqrt(small.face_area.sum(dtype=np.float64) / (FILLED[backend] * most)))
    for _ in range(TRIES):  # how well charts fill pages shows afterwards
        params = UnwrapParams(backend=backend, texel=float(np.clip(wide, 0.0005, 10)), gutter=GUTTER)
        flat = Mesh.load(UNWRAP.run({"mesh": out / "small.npz"}, params, out, silent).files["mesh"])
        pages = json.loads((out / "pages.json").read_text(encoding="utf-8"))
        found = sum(page["width"] * page["height"] for page in pages)
        if found <= most:
            break
        wide *= 1.05 * np.sqrt(found / most)
    _paint(flat, pages, source, out, int(np.clip(np.rint(share.texels**-0.5), 1, FINE)))
    return flat


def _nearest(mesh: Mesh, small: Mesh) -> I64:
    """(F,) of each face of `small`, the face of `mesh` whose middle is nearest to its own."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(mesh.corners.mean(axis=1)).query(small.corners.mean(axis=1))[1], np.int64)


def _simplified(mesh: Mesh, share: float, borders: F64 | None) -> Mesh:
    from scan2sim.pipeline.tiling.borders.open_edges import thinned

    return thinned(mesh, max(LEAST, int(share * len(mesh))), _among(mesh, borders))


def _among(mesh: Mesh, places: F64 | None) -> Bools:
    """(V,) which vertices are at some of these places; None: all."""
    from scipy.spatial import cKDTree

    if places is None:
        return np.ones(len(mesh.vertices), bool)
    if not len(places):
        return np.zeros(len(mesh.vertices), bool)
    return np.isfinite(cKDTree(places).query(mesh.vertices, distance_upper_bound=SAME)[0])


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


def _paint(mesh: Mesh, pages: list[dict[str, int]], source: Path, out: Path, fine: int) -> None:
    """Write a mesh's pages, of these sizes, from the textured mesh in `source`; a texel is the mean of fine² places."""
    from scan2sim.pipeline.camera import renderer
    from scan2sim.texturing.bake import texel_map as texels
    from scan2sim.texturing.bake.page_writer import Writer
    from scan2sim.texturing.inpainting import hole_filling

    assert mesh.uv is not None and mesh.page is not None
    old = renderer.Renderer([renderer.textured(source)])
    writer = Writer()
    for k, size in enumerate(pages):
        faces = np.flatnonzero(mesh.page == k)
        corners = mesh.corners[faces]
        flat = texels.corners(mesh.uv[faces], fine * size["width"], fine * size["height"])
        owner = texels.owners(flat, fine * size["width"], fine * size["height"])
        rows, columns = np.nonzero(owner >= 0)
        rgb = np.zeros((*owner.shape, 3), np.uint8)
        seen = np.zeros(owner.shape, np.uint8)
        for first in range(0, len(rows), CHUNK):
            here = rows[first : first + CHUNK], columns[first : first + CHUNK]
            rgb[here], seen[here], _ = old.nearest(hole_filling.texel_places(owner, flat, corners, *here))
        rgb, seen = _wider(rgb, seen, fine)
        hole_filling.pad(rgb, seen, PADDING)
        writer.write(out / f"page_{k}", hole_filling.Page(rgb, seen, owner, flat, corners))
    writer.finish()


def _wider(rgb: U8, seen: U8, fine: int) -> tuple[U8, U8]:
    """A page of texels `fine` times as wide: the mean of those that have a colour, and the least of their marks."""
    height, width = (side // fine for side in seen.shape)
    marks = seen.reshape(height, fine, width, fine)
    count = (marks > 0).sum(axis=(1, 3))
    total = rgb.reshape(height, fine, width, fine, 3).sum(axis=(1, 3), dtype=np.uint32)
    mean = (total + count[..., None] // 2) // np.maximum(count, 1)[..., None]
    least = np.where(marks > 0, marks, 255).min(axis=(1, 3))
    return mean.astype(np.uint8), np.where(count > 0, least, 0).astype(np.uint8)


def texels_of(shape: Textured) -> int:
    """Of all pages that its faces lie on."""
    from scan2sim.pipeline.io.images import image

    return sum(int(np.prod(image.size_of(shape.pages[page]))) for page in shape.used_pages)
