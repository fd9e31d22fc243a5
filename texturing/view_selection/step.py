"""View selection step (`view_selection`): which photos colour a face, and which one gives its detail.

The candidates of a face are the best few photos that see it. The photo for the detail is selected by a Markov random
field over the faces (`texturing.view_selection.mrf`), so that neighbouring faces share a photo where it costs little.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.parameters import Cosine, Depth, Distance
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, I32, I64, U8, Mesh, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.consistency_result import PhotoConsistency
from scan2sim.texturing.view_selection.choice import Choice

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.depth_map import DepthMap


PANEL_SIDE_MIN_COS = 0.99
"""Cosine of the angle between neighbouring faces on one side of a sign panel."""
PIXEL_COUNT_RATIO_MIN = 0.16
"""Smallest number of pixels that a photo has on a sign panel, relative to the photo with most pixels, to be used."""
VIEWS_PER_FACE_MAX = 8
"""Number of photos from which the low frequencies of a triangle are blended."""


class ViewSelectionParams(Params):
    """Settings of the view selection.

    Attributes:
        smoothness: cost of a seam relative to a photo's quality; 0: each triangle uses its own best photo.
        max_distance: metres from the camera beyond which a photo is not used.
        min_cos: cosine of the angle between surface normal and viewing ray below which a photo is not used.
        bias: metres that a surface may lie behind the depth map and still count as visible.
    """

    smoothness: float = Field(0.3, ge=0, le=1000)
    max_distance: Distance = 100.0
    min_cos: Cosine = 0.02
    bias: Depth = 0.04


def view_selection(inputs: Inputs, params: ViewSelectionParams, out: Path, report: Report) -> Done:
    """Select the photos of every face of `mesh`.

    Inputs: `mesh`, `views`, `depth` (folder of depth maps), `photo_consistency` (usable photos and their masks).
    File: `choice`, a `Choice`.
    """
    from scan2sim.pipeline.camera.depth_map import load_depth_map
    from scan2sim.pipeline.camera.models import pixel_angle

    mesh = Mesh.load(inputs["mesh"])
    views = views_io.load(inputs["views"])
    consistency = PhotoConsistency.load(inputs["photo_consistency"])

    def depth(i: int) -> DepthMap:
        return load_depth_map(inputs["depth"] / f"{i}.npy", views[i].camera, views[i].T_world_cam)

    usable = [i for i in range(len(views)) if consistency.usable[i]]
    choice, seams = choose_views(mesh, views, usable, depth, consistency.mask, consistency.sharpness, params, report)
    choice = with_sign_panel_views(choice, mesh, [pixel_angle(view.camera) for view in views])
    choice.save(out / "choice.npz")
    seen = float((choice.detail_view >= 0).mean()) if len(mesh) else 0.0
    return Done({"choice": out / "choice.npz"}, {"faces": len(mesh), "seen": round(seen, 4), "seam_share": seams})


def choose_views(
    mesh: Mesh,
    views: Any,
    usable: list[int],
    depth: Callable[[int], DepthMap],
    mask: Callable[[int, View], U8],
    sharpness: Callable[[int], float],
    params: ViewSelectionParams,
    report: Report,
) -> tuple[Choice, float]:
    """View selection of all faces, and the share of the total edge length that is a seam."""
    from scan2sim.texturing.view_selection.candidates import Candidates
    from scan2sim.texturing.view_selection.mrf import detail_views

    best = Candidates(mesh.corners, mesh.face_normal, VIEWS_PER_FACE_MAX)
    for done, i in enumerate(usable):
        report(0.7 * done / len(usable), views[i].name)
        best.add_view(
            i, depth(i), bias=params.bias, max_distance=params.max_distance, min_cos=params.min_cos,
            mask=mask(i, views[i]), factor=sharpness(i),
        )  # fmt: skip
    report(0.7, "optimizing seams")
    pairs, length, seam_cost = seam_costs(mesh, params.smoothness)
    selected = detail_views(best.view, best.quality, pairs, seam_cost)
    is_seam = (selected[pairs[:, 0]] != selected[pairs[:, 1]]) & (selected[pairs] >= 0).all(axis=1)
    share = float(length[is_seam].sum() / max(float(length.sum()), 1e-9))
    return Choice(best.view, best.quality, selected), round(share, 4)


def with_sign_panel_views(choice: Choice, mesh: Mesh, pixel: Sequence[float]) -> Choice:
    """View selection with the same photos for a whole side of each sign panel: those that see all of it in detail.

    Sign panels were fitted so that the photos agree on them: the photos' mean is as sharp as they are, with less noise.

    Args:
        choice: view selection of all faces.
        mesh: mesh with the classes of the faces.
        pixel: radians that a pixel of each view spans.
    """
    from scan2sim.texturing.view_selection.mrf import adjacent

    if mesh.classification is None or not (mesh.classification == CODE["road_sign"]).any():
        return choice
    view, quality, detail_view = choice.view.copy(), choice.quality.copy(), choice.detail_view.copy()
    faces = np.flatnonzero(mesh.classification == CODE["road_sign"])
    for side in _panel_sides(mesh, faces, adjacent(mesh.faces[faces])[0]):
        candidates, candidate_quality = view[side], quality[side]
        area = mesh.face_area[side][:, None]
        seen_whole = [v for v in np.unique(candidates[candidates >= 0]) if (candidates == v).any(axis=1).all()]
        views = np.array(seen_whole, np.int32)
        if len(views):
            pixels = np.array([(candidate_quality * area)[candidates == v].sum() / pixel[v] ** 2 for v in views])
            order = np.argsort(-pixels, kind="stable")
            used = views[order][: (pixels >= PIXEL_COUNT_RATIO_MIN * pixels.max()).sum()]
            view[side], quality[side], detail_view[side] = -1, 0, used[0]
            for k, best in enumerate(used):
                view[side, k], quality[side, k] = best, (candidate_quality * (candidates == best)).max(axis=1)
    return Choice(view, quality, detail_view)


def _panel_sides(mesh: Mesh, faces: I64, pairs: I32) -> list[I64]:
    """Connected components of `faces` (N,) that face the same way; `pairs` (E, 2): neighbours, indices into `faces`."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    normal = mesh.face_normal[faces]
    p = pairs[np.einsum("ij,ij->i", normal[pairs[:, 0]], normal[pairs[:, 1]]) > PANEL_SIDE_MIN_COS]
    links = coo_array((np.ones(len(p), np.int8), (p[:, 0], p[:, 1])), shape=(len(faces), len(faces)))
    count, piece = connected_components(links, directed=False)
    return [faces[piece == k] for k in range(count)]


def seam_costs(mesh: Mesh, smoothness: float) -> tuple[I32, F32, F32]:
    """Neighbouring faces (E, 2), the lengths (E,) of their shared edges in metres, and seam costs (E,)."""
    from scan2sim.texturing.view_selection.mrf import adjacent

    pairs, edge = adjacent(mesh.faces)
    length = np.linalg.norm(mesh.vertices[edge[:, 0]] - mesh.vertices[edge[:, 1]], axis=1)
    median = max(float(np.median(length)) if len(length) else 1.0, 1e-9)
    return pairs, length, (smoothness * np.minimum(length / median, 4)).astype(np.float32)


VIEW_SELECTION = Step("view_selection", 4, view_selection, ViewSelectionParams, per_class=True)
