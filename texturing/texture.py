"""Texture: every triangle baked from several photos, warped to its place on the page (D3.2, section 4.2).

Low frequencies are blended from all candidates of a face, weighted by distance (nearer counts more) and angle;
what is finer comes from the one chosen photo, faded into its neighbour's over the triangles along a seam. Colour
is a function of the place on the surface alone, so charts meet without seams. What no photo saw is coloured from
the cloud's points; where they don't tell either, the ground goes on in its pattern (`plan.py`) and all else takes the
mean colour around; both are marked. Pages are baked in bands of rows and photos read when needed,
so memory is bounded by a band and a few photos.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.optional_deps import need
from scan2sim.pipeline.core.parameters import Cosine, Depth, Device
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, I64, U8, Bools, Mesh, PointCloud
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.photo_consistency import Agreement
from scan2sim.texturing.view_selection.step import Choice

if TYPE_CHECKING:
    from scan2sim.texturing.bake.bands import Baker
    from scan2sim.texturing.inpainting.ground import Plan
    from scan2sim.texturing.inpainting.hole_filling import Colours, Page

NEIGHBOUR_STEP = 8
"""Where points have no colour, every so many seen texels (each way) lend theirs to the unseen ones."""


class TextureParams(Params):
    """How photos become texture.

    Attributes:
        power: a photo's weight in the low frequencies is (cos(angle) / distance^2) to this.
        band: pixels of a photo; what is coarser is blended from many photos, what is finer from one. 0: no bands,
            the chosen photo gives all; -1: all photos give all (a plain blend).
        fade: let photos fade into each other over the triangles along a seam.
        min_cos: of the angle between surface normal and ray, below which a photo is not used.
        bias: metres that a surface may lie behind what the depth map shows and still count as seen.
        feather: share of a photo's width over which its weight fades towards its border.
        padding: texels that colours are carried on outside of charts, for mip-maps.
        continued: where neither photo nor coloured point tells anything, the surface goes on as around, patterns kept;
            for what lies flat, as the ground does.
        device: what paints: "numba" the processors, "cuda" (or another device of torch) a GPU, to within one grey
            level the same; "auto": a GPU where torch and one are there.
    """

    power: float = Field(1.5, ge=0.01, le=20)
    band: int = Field(2, ge=-1, le=64)
    fade: bool = True
    min_cos: Cosine = 0.02
    bias: Depth = 0.04
    feather: float = Field(0.04, ge=0.0001, le=0.5)
    padding: int = Field(16, ge=2, le=256)
    continued: bool = False
    device: Device = "auto"


def texture(inputs: Inputs, params: TextureParams, out: Path, report: Report) -> Done:
    """Bake the pages of an unwrapped mesh.

    Inputs: `mesh` (with uv and page), `pages` (their sizes), `choice`, `views`, `depth` (folder of a depth map for
    every view), `exposures`, `agreement`, `cloud.*` (coloured points; that of the classes left out, `cloud.rest`,
    lends no colours), `made.*` (points that were made up, if any), `things` (GeoJSON of those
    that were taken out, if any).
    File: `textured`, a folder with `mesh.npz`, `page_<i>.png` and `page_<i>_seen.png` (255 seen by a photo,
    128 coloured from points, 64 filled from neighbours or by class, 0 no surface).
    """
    from scan2sim.texturing.bake.page_writer import Writer
    from scan2sim.texturing.inpainting import hole_filling
    from scan2sim.texturing.inpainting.point_colours import colours_of, made_colours

    folder = out / "textured"
    folder.mkdir()
    mesh = Mesh.load(inputs["mesh"])
    mesh.save(folder / "mesh.npz")
    if not len(mesh):
        return Done({"textured": folder}, {"area_m2": 0.0, "seen_m2": 0.0, "coverage": 0.0, "pages": 0})
    assert mesh.page is not None
    sizes = json.loads(inputs["pages"].read_text(encoding="utf-8"))
    baker = _baker(mesh, inputs, params)
    plan = _plan(mesh, sizes, inputs) if params.continued else None
    (colours, own), made = colours_of(inputs, plan), made_colours(inputs)
    counts = np.zeros((len(mesh), 4), np.int64)
    writer = Writer()
    for k, size in enumerate(sizes):
        faces = np.flatnonzero(mesh.page == k)
        page = baker.bake(
            faces, size["width"], size["height"],
            lambda f, m="", k=k: report((k + f) / len(sizes), f"page {k + 1} of {len(sizes)} {m}"),
        )  # fmt: skip
        if plan is not None:
            plan.clear(page)
        counts[faces] = _filled(page, faces, mesh, colours, None if own else made)
        if plan is not None:
            plan.add(page)
        waits = plan is not None and bool(counts[faces, 3].any())
        if not waits:
            hole_filling.pad(page.rgb, page.seen, params.padding)
        writer.write(folder / f"page_{k}", page, compression=0 if waits else 2)
        del page
    writer.finish()
    if plan is not None and counts[:, 3].any():
        report(1.0, "ground goes on")
        _go_on(plan, folder, mesh, counts[:, 3] > 0, params)
    skipped = sorted(baker.photos.skipped.values())
    warnings = [f"{reason}: not used for texture, other photos stand in" for reason in skipped]
    return Done({"textured": folder}, _facts(mesh, counts, sizes, baker), warnings)


def _baker(mesh: Mesh, inputs: Inputs, params: TextureParams) -> Baker:
    """What bakes the mesh's pages, with what the steps before have found."""
    from scan2sim.texturing.bake.bands import Baker, best_device
    from scan2sim.texturing.bake.blend_numba import Weighing
    from scan2sim.texturing.photo_cache import Exposures

    return Baker(
        mesh,
        views_io.load(inputs["views"]),
        Choice.load(inputs["choice"]),
        lambda i: inputs["depth"] / f"{i}.npy",
        Exposures.load(inputs["exposures"]),
        Agreement.load(inputs["agreement"]),
        weighing=Weighing(params.bias, params.power, params.feather, params.min_cos, params.band),
        fade=params.fade,
        device=best_device() if params.device == "auto" else params.device,
    )


def _plan(mesh: Mesh, sizes: Sequence[dict[str, int]], inputs: Inputs) -> Plan:
    """The picture from above of an unwrapped mesh, with the classes of the ground's points."""
    from scan2sim.pipeline.dynamic_objects.vehicle_residue import outlines
    from scan2sim.texturing.inpainting.ground import Plan
    from scan2sim.texturing.inpainting.point_colours import classes_of

    cloud = PointCloud.load(inputs["cloud.terrain"])
    stood = outlines(inputs["things"], mesh.frame) if "things" in inputs else []
    return Plan(mesh, _texel(mesh, sizes), cloud.xyz, classes_of(cloud), stood)


def _texel(mesh: Mesh, sizes: Sequence[dict[str, int]]) -> float:
    """Metres that a texel spans where they are fine: of the first quarter of the faces."""
    assert mesh.uv is not None and mesh.page is not None
    pixels = np.array([size["width"] * size["height"] for size in sizes], np.float64)[mesh.page]
    u, v = mesh.uv[:, 1] - mesh.uv[:, 0], mesh.uv[:, 2] - mesh.uv[:, 0]
    texels = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2 * pixels
    return float(np.percentile(np.sqrt(mesh.face_area / np.maximum(texels, 1e-9)), 25))


def _go_on(plan: Plan, folder: Path, mesh: Mesh, wanting: Bools, params: TextureParams) -> None:
    """Paint the pages of the faces that are `wanting` (F,), where the ground goes on, and pad their charts."""
    from scan2sim.texturing.bake import texel_map as texels
    from scan2sim.texturing.bake.page_writer import Writer
    from scan2sim.texturing.inpainting import hole_filling

    ground = plan.go_on()
    assert mesh.page is not None and mesh.uv is not None
    writer = Writer()
    for k in np.unique(mesh.page[wanting]).tolist():
        faces, path = np.flatnonzero(mesh.page == k), folder / f"page_{k}"
        rgb, seen = (
            image.read_rgb(path.with_name(f"{path.name}.png")),
            image.read_levels(path.with_name(f"{path.name}_seen.png")),
        )
        flat = texels.corners(mesh.uv[faces], seen.shape[1], seen.shape[0])
        page = hole_filling.Page(
            rgb, seen, texels.owners(flat, seen.shape[1], seen.shape[0]), flat, mesh.corners[faces]
        )
        if ground is not None:
            ground.fill(page)
        hole_filling.pad(page.rgb, page.seen, params.padding)
        writer.write(path, page)
    writer.finish()


def _filled(
    page: Page,
    faces: I64,
    mesh: Mesh,
    colours: Colours | None,
    made: tuple[F32, U8] | None,
) -> I64:
    """Fill what no photo saw; returns (N, 4) texels of the faces, as `texels.count`.

    Where points have no colours of their own, texels that photos saw stand in, but for what was made up (`made`).
    """
    from scan2sim.texturing.bake import texel_map as texels
    from scan2sim.texturing.inpainting import hole_filling

    area = float(mesh.face_area[faces].sum())
    texel = (area / max(1, int((page.owner >= 0).sum()))) ** 0.5
    if made is not None:  # neighbours that a photo saw are nearer the truth than a class's colour
        places, rgb = hole_filling.seen_points(page, NEIGHBOUR_STEP)
        if len(places):
            xyz, colour = np.concatenate([places, made[0]]), np.concatenate([rgb, made[1]])
            colours = hole_filling.Colours(xyz, colour, hole_filling.FILLED)
    if colours is not None:
        hole_filling.fill(page, colours, max(texel, 1e-6))
    else:
        page.seen[(page.owner >= 0) & (page.seen == 0)] = hole_filling.FILLED
        page.rgb[page.seen == hole_filling.FILLED] = 128
    return np.asarray(texels.count(page.owner, page.seen, page.flat))


def _facts(mesh: Mesh, texels: I64, sizes: Sequence[dict[str, int]], baker: Baker) -> dict[str, Any]:
    """Figures of a texture: areas (m2) by where their colour came from, photos and what each gave."""
    area = mesh.face_area.astype(np.float64)
    share = texels[:, 1:] / np.maximum(texels[:, :1], 1)
    drawn = texels[:, 0] > 0  # a face too small for a texel counts neither way
    total = float(area[drawn].sum())
    seen, coloured, filled = (float(v) for v in (area[drawn, None] * share[drawn]).sum(axis=0))
    return {
        "area_m2": round(total, 2),
        "seen_m2": round(seen, 2),
        "coloured_m2": round(coloured, 2),
        "filled_m2": round(filled, 2),
        "coverage": round(seen / total, 4) if total else 0.0,
        "pages": len(sizes),
        "texels": int(texels[:, 0].sum()),
        "photos": len(baker.used),
        "texels_by_photo": {baker.name(i): n for i, n in sorted(baker.used.items())},
        "skipped": sorted(baker.photos.skipped.values()),
    }


def can_texture(params: TextureParams) -> None:
    """Refuse a device of torch where torch isn't installed.

    Raises:
        UnavailableError: as said.
    """
    if params.device not in ("auto", "numba"):
        need(f"texture.device {params.device}", "torch")


TEXTURE = Step(
    "texture",
    7,
    texture,
    TextureParams,
    class_defaults={"terrain": {"continued": True}},
    check=can_texture,
    per_class=True,
    memory=(1.2, 3),
)
