"""Unwrap step: texture coordinates, on as many pages as the texel density requires.

With the backend "photo", charts are projections into the selected photos (`texturing.photo_charts`). The remaining
faces (at a coarser density where no photo sees them), or all faces with another backend, are unwrapped in blocks
(`texturing.texture_layout`).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import F64, I32, Mesh, View
from scan2sim.pipeline.geometry.coarse_surface import coarse_faces
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.texture_layout import (
    Layout,
    UnwrapParams,
    add_photo_charts,
    add_unwrapped,
    backend_of,
    check_size,
    fallback_of,
    unwrapped,
)
from scan2sim.texturing.view_selection.choice import Choice

ORTHOPHOTO_CENTRE_HEIGHT_M = 1e5
"""Height at which the parallel rays of an orthophoto are taken to meet, metres."""
ORTHOPHOTO_TEXEL_PX = 0.5
"""Texel size on surfaces textured from an orthophoto, in pixels of the orthophoto; never below `texel`."""


def unwrap(inputs: Inputs, params: UnwrapParams, out: Path, report: Report) -> Done:
    """Assign texture coordinates and a page to every face of `mesh`.

    Inputs: `mesh`; for the backend "photo" also `choice` and `views`, and `cloud` and `uncovered` (optional), points
    that photos cover and others: surface at the latter gets the texels of unseen surface; `source_mesh`, a textured
    mesh from which the texture will be baked (optional): texels are then at least as large as its pixels.
    Files: `mesh`, with `uv` and `page`; `pages`, JSON list of {"width", "height"} in texels.

    Raises:
        SettingError: texels are too fine for the area of the surface.
        StepError: neither backend can unwrap a block.
    """
    mesh = Mesh.load(inputs["mesh"])
    layout = Layout.empty(len(mesh))
    if len(mesh):
        if "source_mesh" in inputs:
            from scan2sim.pipeline.io.source_mesh import SourceMesh

            resolution = SourceMesh.load(inputs["source_mesh"]).resolution_m()
            layout = unwrapped(mesh, params.model_copy(update={"texel": max(params.texel, resolution)}), report)
        elif params.backend == "photo":
            detail_view, centres, pixel = _detail_views(inputs)
            orthophoto_pixel = np.append(pixel, 0.0)[detail_view]
            unseen = params.model_copy(update={"texel": params.texel * params.unseen_texel_factor})
            orthophoto_texel = max(params.texel, ORTHOPHOTO_TEXEL_PX * float(orthophoto_pixel.max()))
            orthophoto = params.model_copy(update={"texel": orthophoto_texel})
            sign_panel = params.model_copy(update={"texel": params.texel / params.sign_texel_divisor})
            is_sign = (
                np.zeros(len(mesh), bool) if mesh.classification is None else mesh.classification == CODE["road_sign"]
            )
            coarse = coarse_faces(mesh, inputs)
            from_photo = (detail_view >= 0) & (orthophoto_pixel == 0)
            parts = [(from_photo & ~is_sign & ~coarse, params), (from_photo & ~is_sign & coarse, unseen)]
            parts += [((detail_view >= 0) & (orthophoto_pixel > 0), orthophoto)]
            parts += [(from_photo & is_sign, sign_panel)] if is_sign.any() else []
            texel = np.select([faces for faces, _ in parts], [part.texel for _, part in parts], unseen.texel)
            check_size(float((mesh.face_area / texel**2).sum(dtype=np.float64)), params)
            for faces, part in parts:
                layout = add_photo_charts(mesh, layout, np.where(faces, detail_view, -1), centres, part)
            for faces, part in (*parts, (detail_view < 0, unseen)):
                layout = add_unwrapped(mesh, layout, np.flatnonzero((layout.page < 0) & faces), part, report)
        else:
            layout = unwrapped(mesh, params, report)
    pages, charts, fallbacks = layout.pages, layout.charts, layout.fallbacks
    (out / "pages.json").write_text(json.dumps(pages), encoding="utf-8")
    done = layout.applied_to(mesh)
    done.save(out / "mesh.npz")
    warnings = []
    if fallbacks:
        warnings.append(
            f"{fallbacks} of {len(pages)} blocks were unwrapped by {fallback_of(params)}, "
            f"as {backend_of(params)} failed"
        )
    metrics = _metrics(done, pages) | {"charts": charts, "backend": params.backend, "fallbacks": fallbacks}
    return Done({"mesh": out / "mesh.npz", "pages": out / "pages.json"}, metrics, warnings)


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
    4,
    unwrap,
    UnwrapParams,
    class_defaults={"vegetation": {"texel": 0.03, "gutter": 2}},
    per_class=True,
    memory=(0.5, 10),
)
