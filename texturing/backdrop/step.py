"""Backdrop step: sky dome, and layers of what is too far or too high for the scan, from the photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import F32, I32, Frame, Mesh
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds.scene import LAYERS_PAGE, SKY_PAGE

MIN_BASELINE_SHARE = 0.5
"""Photos closer to each other than this share of `spacing` are not compared."""


class BackdropContext(Context):
    """The tile.

    Attributes:
        cell: the tile's cell within a survey: layers end at its borders, and its dome isn't part of the mesh, as domes
            of several tiles would hide each other (`dome.of_survey`); None: the tile is built alone.
    """

    cell: TileCell | None = None


class BackdropParams(Params):
    """Backdrop: what cameras see beyond the scan.

    Attributes:
        when: auto: if there are photos taken from the street; never: the world ends where the scan ends.
        spacing: distance in metres between the photos that are used; photos in between are left out.
        max_photos: maximum number of photos; with more, the distance between them is larger.
    """

    when: Literal["auto", "never"] = "auto"
    spacing: float = Field(1.0, ge=0.1, le=100)
    max_photos: int = Field(60, ge=2, le=1000)
    context: BackdropContext = BackdropContext()


def backdrop(inputs: Inputs, params: BackdropParams, out: Path, report: Report) -> Done:
    """Fuse depth maps of `views` into layers behind the surfaces `mesh.*`, and collect the sky.

    Inputs: `views`, their `depth` maps and `exposures`; `labels` (optional), class probabilities of photos; `mesh.*`.
    Files: `backdrop`, a textured mesh as of step `texture`: page 0 are the layers, page 1 is the sky dome, for a
    tile of a survey in a file of its own instead (`dome.Dome`). Without photos that can be used, the mesh is empty.
    """
    from scan2sim.pipeline.camera.renderer import Body, Renderer
    from scan2sim.texturing.backdrop import dome, layer_texture, layers, plane_sweep
    from scan2sim.texturing.backdrop import photos as prepared
    from scan2sim.texturing.photo_cache import Exposures

    folder = out / "backdrop"
    folder.mkdir()
    meshes = [Mesh.load(path) for name, path in inputs.items() if name.startswith("mesh.")]
    world, exposures = Renderer([Body(mesh) for mesh in meshes]), Exposures.load(inputs["exposures"])
    views, held_out = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    free = [k for k, held in enumerate(held_out) if not held]
    chosen = prepared.choose(views, free, params.spacing, params.max_photos)
    used = []
    for done, k in enumerate(chosen):
        report(0.3 * done / len(chosen), views[k].name)
        labels = inputs["labels"] / f"{k}.npy" if "labels" in inputs else None
        photo = prepared.prepare(views[k], inputs["depth"] / f"{k}.npy", labels, world, exposures)
        if photo is not None:
            used.append(photo)
    if len(used) < 2:
        _joined(meshes[0].frame, []).save(folder / "mesh.npz")
        return Done({"backdrop": folder}, {"photos": len(used), "triangles": 0})
    for i, photo in enumerate(used):
        report(0.3 + 0.5 * i / len(used), photo.view.name)
        others = plane_sweep.neighbours(used, i, MIN_BASELINE_SHARE * params.spacing)
        photo.inverse = plane_sweep.inverse_depth(photo, [used[j] for j in others])
    report(0.8, "fusing depth maps")
    frame, cell = meshes[0].frame, params.context.cell
    kept = layers.scenery(used)
    cells = layers.fuse(used, kept)
    if cell is not None:
        inside = [layers.within(one, frame, cell.cell) for one in cells]
        cells = [one for one in inside if len(one.rows)]
    report(0.9, "texture")
    whole = dome.from_photos(used, kept)
    sky = whole.colour
    parts = []
    if cells:
        texture, coordinates = layer_texture.page(used, kept, cells, sky)
        image.write(folder / f"page_{LAYERS_PAGE}.png", texture)
        parts.append((LAYERS_PAGE, *layers.mesh(cells, coordinates)))
    else:
        image.write(folder / f"page_{LAYERS_PAGE}.png", sky[:1, :1])
    if cell is None or not cell.neighbours:
        image.write(folder / f"page_{SKY_PAGE}.png", sky)
        parts.append((SKY_PAGE, *dome.mesh(np.mean([photo.view.centre for photo in used], axis=0))))
    else:
        whole.save(folder)
    _joined(frame, parts).save(folder / "mesh.npz")
    metrics = {
        "photos": len(used),
        "triangles": sum(len(faces) for _, _, faces, _ in parts),
        "sky_share": round(float(np.mean([photo.sky.mean() for photo in used])), 3),
    }
    return Done({"backdrop": folder}, metrics)


def _joined(frame: Frame, parts: Sequence[tuple[int, F32, I32, F32]]) -> Mesh:
    """One mesh of parts: page, vertices (V, 3), faces (F, 3), texture coordinates (F, 3, 2)."""
    empty = (0, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3, 2), np.float32))
    pages, vertices, faces, uv = zip(empty, *parts, strict=True)
    start = np.cumsum([0, *map(len, vertices)])
    return Mesh(
        frame,
        np.concatenate(vertices),
        np.concatenate([face + first for face, first in zip(faces, start[:-1], strict=True)]).astype(np.int32),
        uv=np.concatenate(uv),
        page=np.concatenate([np.full(len(face), page, np.int16) for page, face in zip(pages, faces, strict=True)]),
    )


BACKDROP = Step("backdrop", 4, backdrop, BackdropParams, memory=(1.5, 3))
