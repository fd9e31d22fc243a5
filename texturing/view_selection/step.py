"""Choose: which photos colour a face, and which one gives its detail.

Candidates are the best few that see a face; the one for the detail comes from a Markov random field over the
faces (`texturing.view_selection.mrf`), so that neighbours share a photo where it costs little.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.parameters import Cosine, Depth, Reach
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, I32, I64, U8, Mesh, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.photo_consistency import Agreement

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.depth_map import DepthMap


FLAT = 0.99
"""cos of the angle between two faces of one side of a plate."""
FINE_ENOUGH = 0.16
"""Of the finest photo's pixels on a plate, those of the coarsest that it is painted from at least."""


class ChooseParams(Params):
    """How photos are chosen.

    Attributes:
        views_per_face: photos that a triangle's low frequencies are blended from, at most.
        smoothness: price of a seam against a photo's quality; 0: each triangle its own best photo.
        max_distance: metres beyond which a photo is not used.
        min_cos: of the angle between surface normal and ray, below which a photo is not used.
        bias: metres that a surface may lie behind what the depth map shows and still count as seen.
    """

    views_per_face: int = Field(8, ge=1, le=32)
    smoothness: float = Field(0.3, ge=0, le=1000)
    max_distance: Reach = 100.0
    min_cos: Cosine = 0.02
    bias: Depth = 0.04


@dataclass(frozen=True)
class Choice:
    """Photos of faces.

    Attributes:
        view: (F, K) int32 candidates, best first, -1 where fewer see the face.
        quality: (F, K) float32 of each, 1/m2 (cos / distance^2, where seen); 0 where there is none.
        detail_view: (F,) int32, the view that gives the detail, -1 where none sees the face.
    """

    view: I32
    quality: F32
    detail_view: I32

    def save(self, path: Path) -> None:
        """Write as .npz."""
        np.savez(path, view=self.view, quality=self.quality, label=self.detail_view)

    @classmethod
    def load(cls, path: Path) -> Choice:
        """Read what `save` wrote."""
        with np.load(path) as data:
            return cls(data["view"], data["quality"], data["label"])


def choose(inputs: Inputs, params: ChooseParams, out: Path, report: Report) -> Done:
    """Choose the photos of every face of `mesh`.

    Inputs: `mesh`, `views`, `depth` (folder of depth maps), `agreement` (which views may be used, and where).
    File: `choice`, a `Choice`.
    """
    from scan2sim.pipeline.camera.depth_map import load_depth_map
    from scan2sim.pipeline.camera.models import pixel_angle

    mesh = Mesh.load(inputs["mesh"])
    views = views_io.load(inputs["views"])
    agreement = Agreement.load(inputs["agreement"])

    def depth(i: int) -> DepthMap:
        return load_depth_map(inputs["depth"] / f"{i}.npy", views[i].camera, views[i].T_world_cam)

    usable = [i for i in range(len(views)) if agreement.usable[i]]
    choice, seams = choose_views(mesh, views, usable, depth, agreement.mask, agreement.sharpness, params, report)
    choice = with_whole_signs(choice, mesh, [pixel_angle(view.camera) for view in views])
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
    params: ChooseParams,
    report: Report,
) -> tuple[Choice, float]:
    """The choice for all faces, and the share of the edges' length that is a seam."""
    from scan2sim.texturing.view_selection.candidates import Candidates
    from scan2sim.texturing.view_selection.mrf import detail_views

    best = Candidates(mesh.corners, mesh.face_normal, params.views_per_face)
    for done, i in enumerate(usable):
        report(0.7 * done / len(usable), views[i].name)
        best.offer(
            i, depth(i), bias=params.bias, max_distance=params.max_distance, min_cos=params.min_cos,
            mask=mask(i, views[i]), factor=sharpness(i),
        )  # fmt: skip
    report(0.7, "seams")
    pairs, length, price = seams(mesh, params.smoothness)
    chosen = detail_views(best.view, best.quality, pairs, price)
    apart = (chosen[pairs[:, 0]] != chosen[pairs[:, 1]]) & (chosen[pairs] >= 0).all(axis=1)
    share = float(length[apart].sum() / max(float(length.sum()), 1e-9))
    return Choice(best.view, best.quality, chosen), round(share, 4)


def with_whole_signs(choice: Choice, mesh: Mesh, pixel: Sequence[float]) -> Choice:
    """The choice with the same photos for all of each side of a sign's plate: those that see all of it finely.

    Plates hang where photos agree on them: their mean is as sharp as they are, and without their noise.

    Args:
        choice: of all faces.
        mesh: with their classes.
        pixel: radians that a pixel of each view spans.
    """
    from scan2sim.texturing.view_selection.mrf import adjacent

    if mesh.classification is None or not (mesh.classification == CODE["road_sign"]).any():
        return choice
    view, quality, detail_view = choice.view.copy(), choice.quality.copy(), choice.detail_view.copy()
    faces = np.flatnonzero(mesh.classification == CODE["road_sign"])
    for side in _sides(mesh, faces, adjacent(mesh.faces[faces])[0]):
        shown, good = view[side], quality[side]
        area = mesh.face_area[side][:, None]
        whole = np.array([v for v in np.unique(shown[shown >= 0]) if (shown == v).any(axis=1).all()], np.int32)
        if len(whole):
            fineness = np.array([(good * area)[shown == v].sum() / pixel[v] ** 2 for v in whole])
            used = whole[np.argsort(-fineness, kind="stable")][: (fineness >= FINE_ENOUGH * fineness.max()).sum()]
            view[side], quality[side], detail_view[side] = -1, 0, used[0]
            for k, best in enumerate(used):
                view[side, k], quality[side, k] = best, (good * (shown == best)).max(axis=1)
    return Choice(view, quality, detail_view)


def _sides(mesh: Mesh, faces: I64, pairs: I32) -> list[I64]:
    """Faces (N,) in connected pieces that look one way; `pairs` (E, 2) of neighbours, indices into them."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    normal = mesh.face_normal[faces]
    p = pairs[np.einsum("ij,ij->i", normal[pairs[:, 0]], normal[pairs[:, 1]]) > FLAT]
    links = coo_array((np.ones(len(p), np.int8), (p[:, 0], p[:, 1])), shape=(len(faces), len(faces)))
    count, piece = connected_components(links, directed=False)
    return [faces[piece == k] for k in range(count)]


def seams(mesh: Mesh, smoothness: float) -> tuple[I32, F32, F32]:
    """Neighbouring faces (E, 2), the lengths (E,) of their edges in metres, and what a seam there costs (E,)."""
    from scan2sim.texturing.view_selection.mrf import adjacent

    pairs, edge = adjacent(mesh.faces)
    length = np.linalg.norm(mesh.vertices[edge[:, 0]] - mesh.vertices[edge[:, 1]], axis=1)
    median = max(float(np.median(length)) if len(length) else 1.0, 1e-9)
    return pairs, length, (smoothness * np.minimum(length / median, 4)).astype(np.float32)


CHOOSE = Step("choose", 4, choose, ChooseParams, per_class=True)
