"""Unwrap step: texture coordinates, on as many pages as the texel density requires.

With the backend "photo", charts are projections into the selected photos (`texturing.photo_charts`). The remaining
faces (at a coarser density where no photo sees them), or all faces with another backend, are split in space into
blocks that fill one page each. Every block is unwrapped in a child process with a time limit; a block that fails with
one backend is unwrapped by the other.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import SettingError, StepError
from scan2sim.pipeline.core.parameters import Seconds, Texel
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, F64, I32, I64, Mesh, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.view_selection.step import Choice

if TYPE_CHECKING:
    from scan2sim.texturing.atlas import Backend, Unwrapped

    Index = I64

ORTHOPHOTO_CENTRE_HEIGHT_M = 1e5
"""Height at which the parallel rays of an orthophoto are taken to meet, metres."""
ORTHOPHOTO_TEXEL_PX = 0.5
"""Texel size on surfaces textured from an orthophoto, in pixels of the orthophoto; never below `texel`."""
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


def unwrap(inputs: Inputs, params: UnwrapParams, out: Path, report: Report) -> Done:
    """Assign texture coordinates and a page to every face of `mesh`.

    Inputs: `mesh`; for the backend "photo" also `choice` and `views`.
    Files: `mesh`, with `uv` and `page`; `pages`, JSON list of {"width", "height"} in texels.

    Raises:
        SettingError: texels are too fine for the area of the surface.
        StepError: neither backend can unwrap a block.
    """
    mesh = Mesh.load(inputs["mesh"])
    layout = Layout(np.zeros((len(mesh), 3, 2), np.float32), np.full(len(mesh), -1, np.int16), [], 0, 0)
    if len(mesh):
        if params.backend == "photo":
            detail_view, centres, pixel = _detail_views(inputs)
            orthophoto_pixel = np.append(pixel, 0.0)[detail_view]
            unseen = params.model_copy(update={"texel": params.texel * params.unseen_texel_factor})
            orthophoto_texel = max(params.texel, ORTHOPHOTO_TEXEL_PX * float(orthophoto_pixel.max()))
            orthophoto = params.model_copy(update={"texel": orthophoto_texel})
            sign_panel = params.model_copy(update={"texel": params.texel / params.sign_texel_divisor})
            is_sign = (
                np.zeros(len(mesh), bool) if mesh.classification is None else mesh.classification == CODE["road_sign"]
            )
            from_photo = (detail_view >= 0) & (orthophoto_pixel == 0)
            parts = [(from_photo & ~is_sign, params), ((detail_view >= 0) & (orthophoto_pixel > 0), orthophoto)]
            parts += [(from_photo & is_sign, sign_panel)] if is_sign.any() else []
            texel = np.select([faces for faces, _ in parts], [part.texel for _, part in parts], unseen.texel)
            check_size(float((mesh.face_area / texel**2).sum(dtype=np.float64)), params)
            for faces, part in parts:
                layout = add_photo_charts(mesh, layout, np.where(faces, detail_view, -1), centres, part)
            for faces, part in (*parts, (detail_view < 0, unseen)):
                layout = add_unwrapped(mesh, layout, np.flatnonzero((layout.page < 0) & faces), part, report)
        else:
            check_size(float(mesh.face_area.sum(dtype=np.float64)) / params.texel**2, params)
            layout = add_unwrapped(mesh, layout, np.arange(len(mesh)), params, report)
    uv, page, pages, charts, fallbacks = layout.uv, layout.page, layout.pages, layout.charts, layout.fallbacks
    (out / "pages.json").write_text(json.dumps(pages), encoding="utf-8")
    done = Mesh(mesh.frame, mesh.vertices, mesh.faces, mesh.density, uv, page, mesh.classification)
    done.save(out / "mesh.npz")
    warnings = []
    if fallbacks:
        warnings.append(
            f"{fallbacks} of {len(pages)} blocks were unwrapped by {_fallback(params)}, as {_backend(params)} failed"
        )
    metrics = _metrics(done, pages) | {"charts": charts, "backend": params.backend, "fallbacks": fallbacks}
    return Done({"mesh": out / "mesh.npz", "pages": out / "pages.json"}, metrics, warnings)


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


def _detail_views(inputs: Inputs) -> tuple[I32, F64, F64]:
    """Selected view (F,) of every face, camera centres (V, 3), and metres per pixel (V,) of orthophotos, else 0."""
    views = views_io.load(inputs["views"])
    pixel = [1 / min(v.camera.fx, v.camera.fy) if v.camera.model == "orthographic" else 0.0 for v in views]
    centres = np.array([_projection_centre(view) for view in views]).reshape(-1, 3)
    return Choice.load(inputs["choice"]).detail_view, centres, np.array(pixel, np.float64)


def _projection_centre(view: View) -> F64:
    """(3,) projection centre of a view; of an orthographic camera, a point far above its image centre."""
    from scan2sim.pipeline.camera.models import ray_origins

    if view.camera.model != "orthographic":
        return view.centre
    middle = ray_origins(view.camera, [[view.camera.width / 2, view.camera.height / 2]])[0]
    return view.centre + view.T_world_cam[:3, :3] @ (middle - (0.0, 0.0, ORTHOPHOTO_CENTRE_HEIGHT_M))


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
            fallbacks += flat.backend != _backend(params)
        waiting = again
    return Layout(uv, page, pages, charts, fallbacks)


def _backend(params: UnwrapParams) -> Backend:
    """Backend for faces without photo charts."""
    return "uvatlas" if params.backend == "uvatlas" else "xatlas"


def _fallback(params: UnwrapParams) -> Backend:
    """Backend for blocks that `_backend` can't unwrap."""
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
    """Unwrap blocks with one child process per core; failed blocks are retried alone, then by the other backend."""
    from concurrent.futures import ThreadPoolExecutor

    workers = max(1, min(os.cpu_count() or 1, len(blocks)))
    by_size = sorted(range(len(blocks)), key=lambda i: -len(blocks[i]))
    shares = [by_size[k::workers] for k in range(workers)]
    own, other = _backend(params), _fallback(params)
    with ThreadPoolExecutor(workers) as pool:
        first = pool.map(lambda share: _unwrap_in_child(mesh, [blocks[i] for i in share], own, params), shares)
        results: dict[int, Any] = {
            i: one for share, flat in zip(shares, first, strict=True) for i, one in zip(share, flat, strict=True)
        }
        for backend in (own, other):
            failed = [i for i, flat in results.items() if isinstance(flat, str)]
            if backend == own:  # a crash fails all blocks of the child process: retry each block alone
                failed = [i for i in failed if results[i].startswith(CHILD_ERROR) and len(blocks) > workers]
            retried = pool.map(lambda i, b=backend: _unwrap_in_child(mesh, [blocks[i]], b, params)[0], failed)
            results.update(zip(failed, retried, strict=True))
    for i, flat in results.items():
        if isinstance(flat, str):
            raise StepError(
                "unwrap", f"neither UVAtlas nor xatlas can unwrap a block of {len(blocks[i])} faces ({flat})",
                "Set a smaller `unwrap.block_faces`, or decimate the mesh further",
            )  # fmt: skip
    return [results[i] for i in range(len(blocks))]


CHILD_ERROR = "child process: "
"""Prefix of the reasons for blocks whose child process failed."""


def _unwrap_in_child(mesh: Mesh, blocks: list[Index], backend: Backend, params: UnwrapParams) -> list[Unwrapped | str]:
    """Unwrap blocks in one child process; for failed blocks, the reason."""
    from scan2sim.pipeline.core import sandbox

    parts = []
    for block in blocks:
        used, faces = np.unique(mesh.faces[block], return_inverse=True)
        parts.append((mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32)))
    timeout = params.timeout * sum(max(1.0, len(block) / 10_000) for block in blocks)
    try:
        return sandbox.call(
            "scan2sim.texturing.atlas:unwrap_blocks",
            backend,
            parts,
            params.texel,
            params.gutter,
            timeout=timeout,
            threads=1,
        )
    except StepError as error:
        return [CHILD_ERROR + error.cause] * len(blocks)


def _metrics(mesh: Mesh, pages: list[dict[str, int]]) -> dict[str, Any]:
    """Metrics of an unwrapped mesh: pages, texels, utilisation, achieved texel size, stretch."""
    if not pages:
        return {"faces": len(mesh), "pages": 0, "texels": 0}
    assert mesh.uv is not None and mesh.page is not None
    size = np.array([[p["width"], p["height"]] for p in pages], float)
    flat = mesh.uv * size[mesh.page][:, None, :].astype(np.float32)
    a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    texels = float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(dtype=np.float64) / 2)
    area = float(mesh.face_area.sum(dtype=np.float64))
    total = float(size.prod(axis=1).sum())
    return {
        "faces": len(mesh),
        "pages": len(pages),
        "page_sizes": [f"{p['width']}x{p['height']}" for p in pages],
        "texels": int(total),
        "utilisation": round(texels / total, 3),
        "texel_m": round((area / max(texels, 1.0)) ** 0.5, 4),
        "stretch_median": round(float(np.median(stretch(mesh.corners, flat))), 3),
    }


def stretch(corners: npt.NDArray[Any], flat: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(N,) anisotropic stretch: ratio of the singular values of each face's map to the texture, 1 for none.

    Degenerate faces are left out.

    Args:
        corners: (F, 3, 3) corners in space.
        flat: (F, 3, 2) corners in the texture.
    """
    e1, e2 = (corners[:, k].astype(np.float64) - corners[:, 0] for k in (1, 2))
    length = np.linalg.norm(e1, axis=1)
    height = np.linalg.norm(np.cross(e1, e2), axis=1) / np.maximum(length, 1e-12)
    along = np.einsum("ij,ij->i", e1, e2) / np.maximum(length, 1e-12)
    good = (length > 1e-6) & (height > 1e-6)
    # Jacobian of the map from the face's plane (e1 along x) to the texture, solved from both edges
    a, b = (flat[:, k].astype(np.float64) - flat[:, 0] for k in (1, 2))
    jx = a[good] / length[good, None]
    jy = (b[good] - jx * along[good, None]) / height[good, None]
    s = np.linalg.svd(np.stack([jx, jy], axis=2), compute_uv=False)
    return s[:, 0] / np.maximum(s[:, 1], 1e-12)


UNWRAP = Step(
    "unwrap",
    3,
    unwrap,
    UnwrapParams,
    class_defaults={"vegetation": {"texel": 0.03, "gutter": 2}},
    per_class=True,
    memory=(0.5, 10),
)
