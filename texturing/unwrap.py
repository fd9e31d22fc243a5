"""Unwrap: texture coordinates, on as many pages as the texel density asks for.

Charts are cut out of the chosen photos (`texturing.photo_charts`). The rest, at a coarser density where no photo
sees it, or all of it where another backend is asked for, is split in space into blocks, each of which fills one page;
every block is unwrapped by itself in a child process with a time limit. One that a backend refuses goes to the other.
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

FAR = 1e5
"""Metres to where an orthographic camera's rays are taken to meet."""
PER_PIXEL = 0.5
"""Texels of what an orthophoto drapes are this share of its pixels, or `texel` where that is coarser."""
MOST_TEXELS, MOST_PAGES = 4_000_000_000, 10_000
"""Of a class, for what no photo sees finer as well: some 240 pages of 4096 x 4096, 12 GB."""
UTILISATION = 0.5
"""Share of a page that charts are expected to cover, when blocks are cut to pages."""


class UnwrapParams(Params):
    """How the surface is laid flat.

    Attributes:
        backend: "photo" (charts are what one photo sees), "xatlas" (the same at every run) or "uvatlas" (fewer,
            larger charts, several times slower, and never quite the same twice); the latter two are each
            other's fallback, and unwrap what "photo" leaves.
        unseen: how many times wider texels are where no photo sees the surface: points have no finer colours
            ("photo" alone knows).
        texel: metres a texel spans; 1 cm, vegetation 3 cm.
        signs: how many times narrower texels are on the plates of signs, so that they can be read ("photo" alone
            knows).
        page_size: pages are at most this wide and high, texels.
        gutter: texels between charts; 2 for vegetation, whose charts are small and many.
        block_faces: triangles unwrapped at once.
        timeout: seconds that the unwrapping of one block may take, per 10 000 triangles and at least once.
    """

    backend: Literal["photo", "xatlas", "uvatlas"] = "photo"
    unseen: float = Field(4.0, ge=1, le=100)
    texel: Texel = 0.01
    signs: float = Field(2.5, ge=1, le=100)
    page_size: int = Field(4096, ge=64, le=8192)
    gutter: int = Field(4, ge=1, le=64)
    block_faces: int = Field(60_000, ge=100, le=1_000_000)
    timeout: Seconds = 60.0


def unwrap(inputs: Inputs, params: UnwrapParams, out: Path, report: Report) -> Done:
    """Give every face of `mesh` its place on a page.

    Inputs: `mesh`; for the backend "photo" also `choice` and `views`.
    Files: `mesh`, with `uv` and `page`; `pages`, JSON list of {"width", "height"} in texels.

    Raises:
        SettingError: texels are too fine for so large a surface.
        StepError: neither backend can unwrap a block.
    """
    mesh = Mesh.load(inputs["mesh"])
    laid = Laid(np.zeros((len(mesh), 3, 2), np.float32), np.full(len(mesh), -1, np.int16), [], 0, 0)
    if len(mesh):
        if params.backend == "photo":
            detail_view, centres, pixel = _photos(inputs)
            own = np.append(pixel, 0.0)[detail_view]
            coarse = params.model_copy(update={"texel": params.texel * params.unseen})
            draped = params.model_copy(update={"texel": max(params.texel, PER_PIXEL * float(own.max()))})
            finer = params.model_copy(update={"texel": params.texel / params.signs})
            sign = (
                np.zeros(len(mesh), bool) if mesh.classification is None else mesh.classification == CODE["road_sign"]
            )
            by_distance = (detail_view >= 0) & (own == 0)
            parts = [(by_distance & ~sign, params), ((detail_view >= 0) & (own > 0), draped)]
            parts += [(by_distance & sign, finer)] if sign.any() else []
            texel = np.select([faces for faces, _ in parts], [fine.texel for _, fine in parts], coarse.texel)
            check_size(float((mesh.face_area / texel**2).sum(dtype=np.float64)), params)
            for faces, fine in parts:
                laid = lay_by_photo(mesh, laid, np.where(faces, detail_view, -1), centres, fine)
            for faces, fine in (*parts, (detail_view < 0, coarse)):
                laid = lay(mesh, laid, np.flatnonzero((laid.page < 0) & faces), fine, report)
        else:
            check_size(float(mesh.face_area.sum(dtype=np.float64)) / params.texel**2, params)
            laid = lay(mesh, laid, np.arange(len(mesh)), params, report)
    uv, page, pages, charts, fallbacks = laid.uv, laid.page, laid.pages, laid.charts, laid.fallbacks
    (out / "pages.json").write_text(json.dumps(pages), encoding="utf-8")
    done = Mesh(mesh.frame, mesh.vertices, mesh.faces, mesh.density, uv, page, mesh.classification)
    done.save(out / "mesh.npz")
    warnings = []
    if fallbacks:
        warnings.append(f"{fallbacks} of {len(pages)} blocks were unwrapped by {_other(params)}: they were refused")
    facts = _facts(done, pages) | {"charts": charts, "backend": params.backend, "fallbacks": fallbacks}
    return Done({"mesh": out / "mesh.npz", "pages": out / "pages.json"}, facts, warnings)


def check_size(texels: float, params: UnwrapParams) -> None:
    """Refuse so many texels that the pages would fill memory and disk.

    Raises:
        SettingError: naming the finest texel that can be.
    """
    most = min(MOST_TEXELS, MOST_PAGES * UTILISATION * params.page_size**2)
    if texels > most:
        finest = math.ceil(params.texel * math.sqrt(texels / most) * 1e4) / 1e4
        cause = f"{params.texel:g} m a texel makes {texels:,.0f} texels of this surface, more than {most:,.0f}"
        raise SettingError("unwrap.texel", cause, f"Set unwrap.texel={finest:g} or larger, or cut the tile")


@dataclass(frozen=True)
class Laid:
    """Faces laid onto pages so far.

    Attributes:
        uv: (F, 3, 2) float32.
        page: (F,) int16, -1 for those that have none yet.
        pages: width and height of each.
        charts, fallbacks: number of charts, and of blocks that went to the other backend.
    """

    uv: F32
    page: npt.NDArray[np.int16]
    pages: list[dict[str, int]]
    charts: int
    fallbacks: int


def _photos(inputs: Inputs) -> tuple[I32, F64, F64]:
    """The view (F,) of every face's detail, the cameras' centres (V, 3), and metres a pixel (V,), 0 if by distance."""
    views = views_io.load(inputs["views"])
    pixel = [1 / min(v.camera.fx, v.camera.fy) if v.camera.model == "orthographic" else 0.0 for v in views]
    centres = np.array([_eye(view) for view in views]).reshape(-1, 3)
    return Choice.load(inputs["choice"]).detail_view, centres, np.array(pixel, np.float64)


def _eye(view: View) -> F64:
    """(3,) where a view's rays meet: its centre; those of an orthographic camera nearly do so far above its middle."""
    from scan2sim.pipeline.camera.models import ray_origins

    if view.camera.model != "orthographic":
        return view.centre
    middle = ray_origins(view.camera, [[view.camera.width / 2, view.camera.height / 2]])[0]
    return view.centre + view.T_world_cam[:3, :3] @ (middle - (0.0, 0.0, FAR))


def lay_by_photo(mesh: Mesh, laid: Laid, detail_view: I32, centres: F64, params: UnwrapParams) -> Laid:
    """Charts as the chosen photos see them, on pages after those that are there; faces that can't be laid so get none.

    Args:
        detail_view: (F,) the photo of every face, -1 for those that are not to be laid.
        centres: (V, 3) of the cameras.
    """
    from scan2sim.texturing import photo_charts

    uv, page = laid.uv.copy(), laid.page.copy()
    charts = photo_charts.cut(mesh, detail_view, centres, params.texel, params.page_size - 2 * params.gutter)
    place, of, pages = photo_charts.pack(charts.size, params.page_size, params.gutter)
    flat = charts.flat + place[charts.chart][:, None].astype(np.float32)
    good = ~photo_charts.overlapping(flat, of[charts.chart], pages)
    size = np.array(pages, np.float32).reshape(-1, 2)[of[charts.chart]]
    face = charts.face[good]
    page[face] = of[charts.chart][good] + len(laid.pages)
    uv[face] = ((flat + 0.5) / size[:, None])[good]
    uv[face, :, 1] = 1 - uv[face, :, 1]
    pages_now = laid.pages + [{"width": w, "height": h} for w, h in pages]
    return Laid(uv, page, pages_now, laid.charts + len(charts.size), laid.fallbacks)


def lay(mesh: Mesh, laid: Laid, faces: Index, params: UnwrapParams, report: Report) -> Laid:
    """Unwrap faces onto pages of their own, after those that are there."""
    uv, page, pages = laid.uv.copy(), laid.page.copy(), list(laid.pages)
    charts, fallbacks = laid.charts, laid.fallbacks
    waiting = split(mesh, params, faces) if len(faces) else []
    while waiting:
        report(float((page >= 0).mean()), f"{len(waiting)} blocks")
        again: list[Index] = []
        for block, flat in zip(waiting, _unwrap_all(mesh, waiting, params), strict=True):
            if max(flat.width, flat.height) > params.page_size and len(block) > 1:
                again += halves(mesh, block)  # charts left more room between them than was expected
                continue
            page[block] = len(pages)
            uv[block] = flat.uv
            pages.append({k: min(getattr(flat, k), params.page_size) for k in ("width", "height")})
            charts += flat.charts
            fallbacks += flat.backend != _backend(params)
        waiting = again
    return Laid(uv, page, pages, charts, fallbacks)


def _backend(params: UnwrapParams) -> Backend:
    """The unwrapper of what is not cut out of photos."""
    return "uvatlas" if params.backend == "uvatlas" else "xatlas"


def _other(params: UnwrapParams) -> Backend:
    return "xatlas" if params.backend == "uvatlas" else "uvatlas"


def split(mesh: Mesh, params: UnwrapParams, faces: Index) -> list[Index]:
    """Compact blocks of the faces (indices), each of which should fill one page at the asked density."""
    area = mesh.face_area
    limit = UTILISATION * (params.page_size * params.texel) ** 2

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
    """Unwrap blocks on all cores, a child process a core; what fails is tried alone, then by the other backend."""
    from concurrent.futures import ThreadPoolExecutor

    workers = max(1, min(os.cpu_count() or 1, len(blocks)))
    by_size = sorted(range(len(blocks)), key=lambda i: -len(blocks[i]))
    shares = [by_size[k::workers] for k in range(workers)]
    own, other = _backend(params), _other(params)
    with ThreadPoolExecutor(workers) as pool:
        first = pool.map(lambda share: _in_child(mesh, [blocks[i] for i in share], own, params), shares)
        results: dict[int, Any] = {
            i: one for share, flat in zip(shares, first, strict=True) for i, one in zip(share, flat, strict=True)
        }
        for backend in (own, other):
            failed = [i for i, flat in results.items() if isinstance(flat, str)]
            if backend == own:  # one block can take its companions down with it: alone, the others pass
                failed = [i for i in failed if results[i].startswith(CHILD) and len(blocks) > workers]
            retried = pool.map(lambda i, b=backend: _in_child(mesh, [blocks[i]], b, params)[0], failed)
            results.update(zip(failed, retried, strict=True))
    for i, flat in results.items():
        if isinstance(flat, str):
            raise StepError(
                "unwrap", f"neither UVAtlas nor xatlas can unwrap a block of {len(blocks[i])} faces ({flat})",
                "Set a smaller `unwrap.block_faces`, or decimate further",
            )  # fmt: skip
    return [results[i] for i in range(len(blocks))]


CHILD = "child process: "


def _in_child(mesh: Mesh, blocks: list[Index], backend: Backend, params: UnwrapParams) -> list[Unwrapped | str]:
    """Unwrap blocks in one child process; a reason for each that failed."""
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
        return [CHILD + error.cause] * len(blocks)


def _facts(mesh: Mesh, pages: list[dict[str, int]]) -> dict[str, Any]:
    """Figures of an unwrapped mesh: pages, texels, utilisation, density achieved, stretch."""
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
    """(N,) how much longer one direction of a face is drawn than the other, 1 for none; degenerate faces left out.

    Args:
        corners: (F, 3, 3) in space.
        flat: (F, 3, 2) in the texture.
    """
    e1, e2 = (corners[:, k].astype(np.float64) - corners[:, 0] for k in (1, 2))
    length = np.linalg.norm(e1, axis=1)
    height = np.linalg.norm(np.cross(e1, e2), axis=1) / np.maximum(length, 1e-12)
    along = np.einsum("ij,ij->i", e1, e2) / np.maximum(length, 1e-12)
    good = (length > 1e-6) & (height > 1e-6)
    # the map from the face's own plane (e1 along x) to the texture, columns by solving for both edges
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
