"""Texture step: bakes every triangle from several photos onto texture pages (D3.2, section 4.2).

Low frequencies are blended from all candidate photos of a face, weighted by distance (nearer counts more) and angle.
Detail comes from the one selected photo and is cross-faded over the triangles along a seam. The colour depends only on
the position on the surface, so charts meet without seams. Surfaces that no photo saw take the colours of nearby points.
Where there are no point colours either, the ground is inpainted with its own pattern (`inpainting.ground`) and all
other surfaces take the mean colour around them; both are marked in the page's mask. Pages are baked in bands of rows
and photos are read when needed, so memory is bounded by one band and a few photos.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import Group
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.parameters import Cosine, Depth, Device
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, I64, U8, Bools, Mesh, PointCloud
from scan2sim.pipeline.geometry.coarse_surface import coarse_faces
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.consistency_result import PhotoConsistency
from scan2sim.texturing.texture_page import FILLED, Page
from scan2sim.texturing.view_selection.choice import Choice

if TYPE_CHECKING:
    from scan2sim.texturing.bake.bands import Baker
    from scan2sim.texturing.bake.source_texture import SourceTexture
    from scan2sim.texturing.inpainting.ground import GroundOrthophoto
    from scan2sim.texturing.inpainting.hole_filling import PointColours

SEEN_TEXEL_STRIDE = 8
"""Where the points have no colours, every Nth seen texel (in both directions) is a colour sample for unseen texels."""


class TextureContext(Context):
    """The surface that the mesh is; None: unknown."""

    surface: Group | None = None


class TextureParams(Params):
    """Settings of texture baking.

    Attributes:
        power: exponent of a photo's weight in the low frequencies: (cos(angle) / distance^2) ^ power.
        band: wavelength, in pixels of a photo, that separates low frequencies (blended from many photos) from detail
            (taken from one photo). 0: no bands, the selected photo gives everything; -1: plain blend of all photos.
        fade: cross-fade photos over the triangles along a seam.
        min_cos: cosine of the angle between surface normal and viewing ray below which a photo is not used.
        bias: metres that a surface may lie behind the depth map and still count as visible.
        feather: share of a photo's width over which its weight fades towards the photo's border.
        padding: texels by which colours are extended beyond the charts, for mip-maps.
        inpaint: inpaint surfaces for which neither a photo nor a point gives a colour, keeping the pattern around
            them; for flat surfaces such as the ground.
        device: "numba": CPU; "cuda" or another torch device: GPU, equal to the CPU within one grey level; "auto": GPU
            if torch and a GPU are available.
        context: the mesh.
    """

    power: float = Field(1.5, ge=0.01, le=20)
    band: int = Field(2, ge=-1, le=64)
    fade: bool = True
    min_cos: Cosine = 0.02
    bias: Depth = 0.04
    feather: float = Field(0.04, ge=0.0001, le=0.5)
    padding: int = Field(16, ge=2, le=256)
    inpaint: bool = False
    device: Device = "auto"
    context: TextureContext = TextureContext()


def texture(inputs: Inputs, params: TextureParams, out: Path, report: Report) -> Done:
    """Bake the texture pages of an unwrapped mesh.

    Inputs: `mesh` (with uv and page), `pages` (their sizes), `choice` (selected photos), `views`, `depth`
    (folder with a depth map for every view), `exposures`, `photo_consistency` (masks and warps of the photos),
    `cloud.*` (coloured points; `cloud.rest`, the classes without a surface, is not used for colours), `raw.*`
    (points that `cloud.*` were thinned from, used instead if they are coloured; optional), `uncovered` (thinned points
    that photos don't cover, optional), `synthesized.*` (synthesized points, optional), `instances` (GeoJSON of the
    removed vehicles and people, optional), `colour_source` (of a robot's map: step `map_colours`, optional),
    `source_mesh` (the textured mesh that the tile was made from, optional: its texture counts as a photo).
    File: `textured`, a folder with `mesh.npz`, `page_<i>.png` and `page_<i>_seen.png` (255 seen by a photo,
    128 coloured from points, 64 filled from neighbours or by class, 0 no surface).
    """
    from scan2sim.texturing.inpainting.point_colours import point_colours, synthesized_colours

    folder = out / "textured"
    folder.mkdir()
    mesh = Mesh.load(inputs["mesh"])
    mesh.save(folder / "mesh.npz")
    if not len(mesh):
        return Done({"textured": folder}, {"area_m2": 0.0, "seen_m2": 0.0, "coverage": 0.0, "pages": 0})
    assert mesh.page is not None
    sizes = json.loads(inputs["pages"].read_text(encoding="utf-8"))
    coarse = coarse_faces(mesh, inputs)
    baker = _baker(mesh, inputs, params)
    source = _source_texture(mesh, inputs)
    ground = _ground_orthophoto(mesh, sizes, inputs) if params.inpaint else None
    colours, measured = point_colours(inputs, ground, params.context.surface)
    synthesized = synthesized_colours(inputs)
    counts = np.zeros((len(mesh), 4), np.int64)
    pages = Pages(folder, out / ".unfinished", params.padding)
    for k, size in enumerate(sizes):
        faces = np.flatnonzero(mesh.page == k)
        page = baker.bake(
            faces, size["width"], size["height"],
            lambda f, m="", k=k: report((k + f) / len(sizes), f"page {k + 1} of {len(sizes)} {m}"),
        )  # fmt: skip
        if source is not None:
            source.paint(page)
        if ground is not None:
            ground.clear_removed(page)
        counts[faces] = _fill_unseen(page, faces, mesh, colours, None if measured else synthesized)
        if ground is not None:
            ground.add(page)
        if ground is not None and bool(counts[faces, 3].any()):
            pages.keep(k, page)
        else:
            pages.finish(k, page)
        del page
    if ground is not None and pages.kept:
        report(1.0, "inpainting the ground")
        baker.forget_photos()
        del colours, synthesized
        inpainted = ground.inpaint()
        for k in pages.kept:
            page = pages.load(k, mesh)
            if inpainted is not None:
                inpainted.fill(page)
            pages.finish(k, page)
    pages.close()
    skipped = sorted(baker.photos.skipped.values())
    warnings = [f"{reason}: not used for texture; other photos replace it" for reason in skipped]
    return Done({"textured": folder}, _metrics(mesh, coarse, counts, sizes, baker), warnings)


def _baker(mesh: Mesh, inputs: Inputs, params: TextureParams) -> Baker:
    """`Baker` for the mesh's pages, set up with the results of the previous steps."""
    from scan2sim.texturing.bake.bands import Baker, best_device
    from scan2sim.texturing.bake.blend_numba import BlendSettings
    from scan2sim.texturing.photo_cache import Exposures

    return Baker(
        mesh,
        views_io.load(inputs["views"]),
        Choice.load(inputs["choice"]),
        lambda i: inputs["depth"] / f"{i}.npy",
        Exposures.load(inputs["exposures"]),
        PhotoConsistency.load(inputs["photo_consistency"]),
        settings=BlendSettings(params.bias, params.power, params.feather, params.min_cos, params.band),
        fade=params.fade,
        device=best_device() if params.device == "auto" else params.device,
    )


def _source_texture(mesh: Mesh, inputs: Inputs) -> SourceTexture | None:
    """The texture of the mesh that the tile was made from, or None."""
    if "source_mesh" not in inputs:
        return None
    from scan2sim.pipeline.io.source_mesh import SourceMesh
    from scan2sim.texturing.bake.source_texture import SourceTexture

    return SourceTexture(SourceMesh.load(inputs["source_mesh"]).moved_to(mesh.frame))


def _ground_orthophoto(mesh: Mesh, sizes: Sequence[dict[str, int]], inputs: Inputs) -> GroundOrthophoto:
    """Empty orthophoto of an unwrapped ground mesh, with the classes of the ground points."""
    from scan2sim.pipeline.dynamic_objects.vehicle_residue import parked_vehicle_outlines
    from scan2sim.texturing.inpainting.ground import GroundOrthophoto
    from scan2sim.texturing.inpainting.point_colours import classes_of

    cloud = PointCloud.load(inputs["cloud.terrain"])
    removed = parked_vehicle_outlines(inputs["instances"], mesh.frame) if "instances" in inputs else []
    return GroundOrthophoto(mesh, _texel_m(mesh, sizes), cloud.xyz, classes_of(cloud), removed)


def _texel_m(mesh: Mesh, sizes: Sequence[dict[str, int]]) -> float:
    """Texel size in metres where texels are fine: 25th percentile over the faces."""
    assert mesh.uv is not None and mesh.page is not None
    pixels = np.array([size["width"] * size["height"] for size in sizes], np.float64)[mesh.page]
    u, v = mesh.uv[:, 1] - mesh.uv[:, 0], mesh.uv[:, 2] - mesh.uv[:, 0]
    texels = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2 * pixels
    return float(np.percentile(np.sqrt(mesh.face_area / np.maximum(texels, 1e-9)), 25))


class Pages:
    """Files of the texture pages.

    Args:
        folder: receives the finished pages.
        unfinished: folder for those that wait for the inpainted ground; removed at the end.
        padding: as in `TextureParams`.

    Attributes:
        kept: the pages that wait.
    """

    def __init__(self, folder: Path, unfinished: Path, padding: int) -> None:
        from scan2sim.texturing.bake.page_writer import PageWriter

        self._folder, self._unfinished, self._padding = folder, unfinished, padding
        self._writer = PageWriter()
        self.kept: list[int] = []

    def keep(self, k: int, page: Page) -> None:
        """Keep page `k` for later."""
        self._unfinished.mkdir(exist_ok=True)
        np.save(self._unfinished / f"{k}.npy", page.rgb)
        np.save(self._unfinished / f"{k}_seen.npy", page.seen)
        self.kept.append(k)

    def load(self, k: int, mesh: Mesh) -> Page:
        """Page `k` as it was kept."""
        from scan2sim.texturing import texel_map

        assert mesh.page is not None and mesh.uv is not None
        faces, rgb, seen = (
            np.flatnonzero(mesh.page == k),
            np.load(self._unfinished / f"{k}.npy"),
            np.load(self._unfinished / f"{k}_seen.npy"),
        )
        flat = texel_map.corners(mesh.uv[faces], seen.shape[1], seen.shape[0])
        return Page(rgb, seen, texel_map.owners(flat, seen.shape[1], seen.shape[0]), flat, mesh.corners[faces])

    def finish(self, k: int, page: Page) -> None:
        """Pad the charts of page `k`, and write it in the background."""
        from scan2sim.texturing.inpainting import hole_filling

        hole_filling.pad(page.rgb, page.seen, self._padding)
        self._writer.write(self._folder / f"page_{k}", page)

    def close(self) -> None:
        """Wait until all pages are written."""
        self._writer.finish()
        shutil.rmtree(self._unfinished, ignore_errors=True)


def _fill_unseen(
    page: Page,
    faces: I64,
    mesh: Mesh,
    colours: PointColours | None,
    synthesized: tuple[F32, U8] | None,
) -> I64:
    """Fill the texels that no photo saw; returns (N, 4) texels of the faces, as `texel_map.count`.

    Where the points have no measured colours, colours come from nearby seen texels and, at synthesized points, from
    `synthesized` (positions, colours); None: the points have measured colours.
    """
    from scan2sim.texturing import texel_map as texels
    from scan2sim.texturing.inpainting import hole_filling

    area = float(mesh.face_area[faces].sum())
    texel = (area / max(1, int((page.owner >= 0).sum()))) ** 0.5
    if synthesized is not None:  # nearby texels that a photo saw are closer to the truth than a class's colour
        positions, rgb = hole_filling.seen_points(page, SEEN_TEXEL_STRIDE)
        if len(positions):
            xyz, colour = np.concatenate([positions, synthesized[0]]), np.concatenate([rgb, synthesized[1]])
            colours = hole_filling.PointColours(xyz, colour, FILLED)
    if colours is not None:
        hole_filling.fill(page, colours, max(texel, 1e-6))
    else:
        page.seen[(page.owner >= 0) & (page.seen == 0)] = FILLED
        page.rgb[page.seen == FILLED] = 128
    return np.asarray(texels.count(page.owner, page.seen, page.flat))


def _metrics(mesh: Mesh, coarse: Bools, texels: I64, sizes: Sequence[dict[str, int]], baker: Baker) -> dict[str, Any]:
    """Metrics of a texture: areas (m2) by the source of their colour, photos used and texels from each.

    Coarse faces (F,), which photos don't cover, count as `coarse_m2` alone.
    """
    area = mesh.face_area.astype(np.float64)
    share = texels[:, 1:] / np.maximum(texels[:, :1], 1)
    has_texels = (texels[:, 0] > 0) & ~coarse  # faces smaller than a texel are not counted
    total = float(area[has_texels].sum())
    seen, coloured, filled = (float(v) for v in (area[has_texels, None] * share[has_texels]).sum(axis=0))
    return {
        "area_m2": round(total, 2),
        "seen_m2": round(seen, 2),
        "coloured_m2": round(coloured, 2),
        "filled_m2": round(filled, 2),
        "coarse_m2": round(float(area[coarse].sum()), 2),
        "coverage": round(seen / total, 4) if total else 0.0,
        "pages": len(sizes),
        "texels": int(texels[:, 0].sum()),
        "photos": len(baker.used),
        "texels_by_photo": {baker.name(i): n for i, n in sorted(baker.used.items())},
        "skipped": sorted(baker.photos.skipped.values()),
    }


def can_texture(params: TextureParams) -> None:
    """Check that torch is installed if `device` is a torch device.

    Raises:
        UnavailableError: torch is missing.
    """
    if params.device not in ("auto", "numba"):
        require(f"texture.device {params.device}", "torch")


TEXTURE = Step(
    "texture",
    11,
    texture,
    TextureParams,
    class_defaults={"terrain": {"inpaint": True}},
    check=can_texture,
    per_class=True,
    memory=(1.2, 3),
)
