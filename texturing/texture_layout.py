"""Layout of textures: faces get texture coordinates on as many pages as the texel density requires.

Charts are projections into photos (`texturing.photo_charts`), or faces are split in space into blocks that fill one
page each. Every block is unwrapped in a child process with a time limit; a block that fails with one backend is
unwrapped by the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from scan2sim.pipeline.core.cores import available_cores
from scan2sim.pipeline.core.errors import SettingError, StepError
from scan2sim.pipeline.core.parameters import Seconds, Texel
from scan2sim.pipeline.core.step import Params, Report
from scan2sim.pipeline.core.types import F32, F64, I32, I64, Mesh

if TYPE_CHECKING:
    from scan2sim.texturing.atlas import Backend, Unwrapped

    Index = I64

MAX_TEXELS, MAX_PAGES = 4_000_000_000, 10_000
"""Limits per class: about 240 pages of 4096 x 4096 texels, 12 GB."""
EXPECTED_UTILISATION = 0.5
"""Share of a page that charts are expected to cover, when blocks are cut to pages."""


class UnwrapParams(Params):
    """Settings of the texture coordinates.

    Attributes:
        backend: "photo" (charts are projections into one photo), "xatlas" (deterministic) or "uvatlas" (fewer, larger
            charts, several times slower, not deterministic). "xatlas" and "uvatlas" are each other's fallback;
            "xatlas" unwraps what "photo" leaves.
        unseen_texel_factor: factor on the texel size where no photo sees the surface, as point colours are coarser
            (only with "photo").
        texel: texel size in metres; 1 cm, vegetation 3 cm.
        sign_texel_divisor: divisor of the texel size on sign panels, so that they can be read (only with "photo").
        page_size: largest width and height of a page in texels.
        gutter: texels between charts; 2 for vegetation, which has many small charts.
        block_faces: maximum number of triangles unwrapped at once.
        timeout: time limit for unwrapping a block, in seconds per 10 000 triangles (blocks with fewer get it in full).
    """

    backend: Literal["photo", "xatlas", "uvatlas"] = "photo"
    unseen_texel_factor: float = Field(4.0, ge=1, le=100)
    texel: Texel = 0.01
    sign_texel_divisor: float = Field(2.5, ge=1, le=100)
    page_size: int = Field(4096, ge=64, le=8192)
    gutter: int = Field(4, ge=1, le=64)
    block_faces: int = Field(60_000, ge=100, le=1_000_000)
    timeout: Seconds = 60.0


def check_size(texels: float, params: UnwrapParams) -> None:
    """Check that the pages fit into memory and onto disk.

    Raises:
        SettingError: there are too many texels; names the smallest possible texel size.
    """
    limit = min(MAX_TEXELS, MAX_PAGES * EXPECTED_UTILISATION * params.page_size**2)
    if texels > limit:
        finest = math.ceil(params.texel * math.sqrt(texels / limit) * 1e4) / 1e4
        cause = f"texels of {params.texel:g} m give {texels:,.0f} texels for this surface, more than {limit:,.0f}"
        raise SettingError("unwrap.texel", cause, f"Set unwrap.texel={finest:g} or larger, or use smaller tiles")


@dataclass(frozen=True)
class Layout:
    """Texture coordinates of the faces that are laid out so far.

    Attributes:
        uv: (F, 3, 2) float32 texture coordinates.
        page: (F,) int16 page, -1 for faces that have none yet.
        pages: width and height of each page.
        charts, fallbacks: number of charts, and of blocks that were unwrapped by the fallback backend.
    """

    uv: F32
    page: npt.NDArray[np.int16]
    pages: list[dict[str, int]]
    charts: int
    fallbacks: int

    @classmethod
    def empty(cls, faces: int) -> Layout:
        """Layout of a mesh whose faces have no texture coordinates yet."""
        return cls(np.zeros((faces, 3, 2), np.float32), np.full(faces, -1, np.int16), [], 0, 0)

    def applied_to(self, mesh: Mesh) -> Mesh:
        """The mesh with these texture coordinates."""
        return Mesh(mesh.frame, mesh.vertices, mesh.faces, mesh.density, self.uv, self.page, mesh.classification)


def unwrapped(mesh: Mesh, params: UnwrapParams, report: Report) -> Layout:
    """Layout of all faces, unwrapped by xatlas or UVAtlas.

    Raises:
        SettingError: texels are too fine for the area of the surface.
        StepError: neither backend can unwrap a block.
    """
    check_size(float(mesh.face_area.sum(dtype=np.float64)) / params.texel**2, params)
    return add_unwrapped(mesh, Layout.empty(len(mesh)), np.arange(len(mesh)), params, report)


def add_photo_charts(mesh: Mesh, layout: Layout, detail_view: I32, centres: F64, params: UnwrapParams) -> Layout:
    """Layout with charts projected into the selected photos, on new pages; faces that don't fit into any get none.

    Args:
        mesh: mesh to be unwrapped.
        layout: layout so far.
        detail_view: (F,) photo of every face, -1 for faces that are not to be laid out.
        centres: (V, 3) projection centres of the cameras.
        params: settings.
    """
    from scan2sim.texturing import photo_charts

    uv, page = layout.uv.copy(), layout.page.copy()
    charts = photo_charts.cut(mesh, detail_view, centres, params.texel, params.page_size - 2 * params.gutter)
    position, chart_page, pages = photo_charts.pack(charts.size, params.page_size, params.gutter)
    flat = charts.flat + position[charts.chart][:, None].astype(np.float32)
    good = ~photo_charts.overlapping(flat, chart_page[charts.chart], pages)
    size = np.array(pages, np.float32).reshape(-1, 2)[chart_page[charts.chart]]
    face = charts.face[good]
    page[face] = chart_page[charts.chart][good] + len(layout.pages)
    uv[face] = ((flat + 0.5) / size[:, None])[good]
    uv[face, :, 1] = 1 - uv[face, :, 1]
    all_pages = layout.pages + [{"width": w, "height": h} for w, h in pages]
    return Layout(uv, page, all_pages, layout.charts + len(charts.size), layout.fallbacks)


def add_unwrapped(mesh: Mesh, layout: Layout, faces: Index, params: UnwrapParams, report: Report) -> Layout:
    """Layout with `faces` (N,) unwrapped by xatlas or UVAtlas, on new pages."""
    uv, page, pages = layout.uv.copy(), layout.page.copy(), list(layout.pages)
    charts, fallbacks = layout.charts, layout.fallbacks
    waiting = page_blocks(mesh, params, faces) if len(faces) else []
    while waiting:
        report(float((page >= 0).mean()), f"{len(waiting)} blocks left")
        again: list[Index] = []
        for block, flat in zip(waiting, _unwrap_all(mesh, waiting, params), strict=True):
            if max(flat.width, flat.height) > params.page_size and len(block) > 1:
                again += halves(mesh, block)  # the page's utilisation is lower than expected
                continue
            page[block] = len(pages)
            uv[block] = flat.uv
            pages.append({k: min(getattr(flat, k), params.page_size) for k in ("width", "height")})
            charts += flat.charts
            fallbacks += flat.backend != backend_of(params)
        waiting = again
    return Layout(uv, page, pages, charts, fallbacks)


def backend_of(params: UnwrapParams) -> Backend:
    """Backend for faces without photo charts."""
    return "uvatlas" if params.backend == "uvatlas" else "xatlas"


def fallback_of(params: UnwrapParams) -> Backend:
    """Backend for blocks that `backend_of` can't unwrap."""
    return "xatlas" if params.backend == "uvatlas" else "uvatlas"


def page_blocks(mesh: Mesh, params: UnwrapParams, faces: Index) -> list[Index]:
    """Compact blocks of `faces` (N,), each of which should fill one page at the wanted density."""
    area = mesh.face_area
    limit = EXPECTED_UTILISATION * (params.page_size * params.texel) ** 2

    def cut(block: Index) -> list[Index]:
        if len(block) < 2 or (area[block].sum() <= limit and len(block) <= params.block_faces):
            return [block]
        return [part for half in halves(mesh, block) for part in cut(half)]

    return cut(faces)


def halves(mesh: Mesh, block: Index) -> list[Index]:
    """A block cut across its longest side into two of about equal area; indices stay ascending."""
    centre = mesh.vertices[mesh.faces[block]].mean(axis=1)
    order = np.argsort(centre[:, np.ptp(centre, axis=0).argmax()], kind="stable")
    area = np.cumsum(mesh.face_area[block][order], dtype=np.float64)
    middle = int(np.clip(np.searchsorted(area, area[-1] / 2), 1, len(block) - 1))
    return [np.sort(block[order[:middle]]), np.sort(block[order[middle:]])]


def _unwrap_all(mesh: Mesh, blocks: list[Index], params: UnwrapParams) -> list[Unwrapped]:
    """Unwrap blocks, each in a child process, one per core at a time; those that fail by the other backend."""
    from concurrent.futures import ThreadPoolExecutor

    own, other = backend_of(params), fallback_of(params)
    by_size = sorted(range(len(blocks)), key=lambda i: -len(blocks[i]))
    results: dict[int, Unwrapped] = {}
    failed: dict[int, str] = {}
    with ThreadPoolExecutor(max(1, min(available_cores(), len(blocks)))) as pool:
        for i, flat in zip(by_size, pool.map(lambda i: _in_child(mesh, blocks[i], own, params), by_size), strict=True):
            if isinstance(flat, str):
                failed[i] = flat
            else:
                results[i] = flat
        retried = pool.map(lambda i: _in_child(mesh, blocks[i], other, params), failed)
        for (i, reason), flat in zip(failed.items(), retried, strict=True):
            if isinstance(flat, str):
                raise StepError(
                    "unwrap",
                    f"neither {own} ({reason}) nor {other} ({flat}) can unwrap a block of {len(blocks[i])} faces",
                    "Set a smaller `unwrap.block_faces`, or decimate the mesh further",
                )
            results[i] = flat
    return [results[i] for i in range(len(blocks))]


def _in_child(mesh: Mesh, block: Index, backend: Backend, params: UnwrapParams) -> Unwrapped | str:
    """Unwrap a block in a child process; the reason if it fails."""
    from scan2sim.pipeline.core import sandbox

    used, faces = np.unique(mesh.faces[block], return_inverse=True)
    part = mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32)
    timeout = params.timeout * max(1.0, len(block) / 10_000)
    target = "scan2sim.texturing.atlas:unwrap_block"
    try:
        unwrapped: Unwrapped = sandbox.call(
            target, backend, *part, params.texel, params.gutter, timeout=timeout, threads=1
        )
    except StepError as error:
        return error.cause
    return unwrapped
