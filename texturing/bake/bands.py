"""Photos baked onto pages, band by band: memory is bounded by a band and a few photos. Import late: it loads numba."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import scipy.sparse as sp

from scan2sim.pipeline.camera.depth_map import load_depth_map
from scan2sim.pipeline.camera.projection import eye
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.optional_deps import missing
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F32, I32, I64, Mesh, View
from scan2sim.texturing.bake import texel_map
from scan2sim.texturing.bake.blend_numba import Laid, NumbaRows, Occlusion, Picture, Rows, Source, Weighing
from scan2sim.texturing.inpainting.hole_filling import Page
from scan2sim.texturing.photo_cache import Exposures, Photos
from scan2sim.texturing.photo_consistency import Agreement
from scan2sim.texturing.view_selection.step import Choice

BAND = 6_000_000
"""Texels of a page that are baked at a time, in whole rows."""
KEPT = 8
"""Depth maps kept in memory."""


class Baker:
    """Bakes photos onto pages, band by band.

    Args:
        mesh: with uv and page.
        views: all, by index.
        choice: the photos of every face of the mesh.
        depth_file: index of a view to the file of its depth map.
        exposures: of the photos.
        agreement: where photos may be used, and how they are displaced.
        weighing: of photos; its feather is a share of a photo's width here.
        fade: let photos fade into each other over the triangles along a seam.
        device: what bakes, "numba" or a device of torch.

    Attributes:
        used: index of a view to the number of texels that it contributed to.
        photos: the source of photos, which knows those that can't be read.
    """

    def __init__(
        self,
        mesh: Mesh,
        views: Sequence[View],
        choice: Choice,
        depth_file: Callable[[int], Path],
        exposures: Exposures,
        agreement: Agreement,
        *,
        weighing: Weighing,
        fade: bool,
        device: str,
    ) -> None:
        self._mesh, self._views = mesh, views
        self._weighing, self._fade, self._device = weighing, fade, device
        self._corners, self._normals = mesh.corners, mesh.face_normal
        self._choice, self._depth_file, self._exposures = choice, depth_file, exposures
        self._mask, self._warp = agreement.mask, agreement.warp
        self._share = shares(mesh.faces, choice.detail_view, len(mesh.vertices), len(views))
        classification = mesh.classification
        self._sign = np.zeros(len(mesh), bool) if classification is None else classification == CODE["road_sign"]
        self._backwards = True
        self._occlusion = lru_cache(maxsize=KEPT)(self._read_occlusion)
        self.photos = Photos(views, max(1, weighing.band))
        self.used: dict[int, int] = {}

    def bake(self, faces: I64, width: int, height: int, report: Report) -> Page:
        """A page baked from photos alone; texels that none saw stay black and unmarked.

        Args:
            faces: (N,) those on the page.
            width, height: of the page, texels.
            report: progress.
        """
        assert self._mesh.uv is not None
        flat = texel_map.corners(self._mesh.uv[faces], width, height)
        owner = texel_map.owners(flat, width, height)
        page = Page(
            np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.uint8), owner, flat,
            self._corners[faces],
        )  # fmt: skip
        low, high = flat[..., 1].min(axis=1), flat[..., 1].max(axis=1)
        band = max(1, BAND // width)
        for first in range(0, height, band):
            report(first / height)
            rows = slice(first, min(height, first + band))
            here = np.flatnonzero((high >= rows.start) & (low <= rows.stop))
            if len(here):
                self._bake_rows(page, rows, here, faces)
        return page

    def _bake_rows(self, page: Page, rows: slice, here: I64, faces: I64) -> None:
        """Bake the rows of a page; `here` are its faces (indices into `faces`) that reach into them."""
        flat = page.flat - np.array([0, rows.start], np.float32)
        band = self._rows(Laid(page.owner[rows], flat, page.corners, self._normals[faces]))
        candidates = self._choice.view[faces[here]]
        order = np.unique(candidates[candidates >= 0]).tolist()
        self._backwards = not self._backwards  # what the last rows read last is still in memory
        for i in reversed(order) if self._backwards else order:
            mine = here[(candidates == i).any(axis=1)]
            seen = self._add_photo(i, band, mine, faces[mine])
            if seen:
                self.used[i] = self.used.get(i, 0) + seen
        band.resolve(page.rgb[rows], page.seen[rows])

    def _rows(self, laid: Laid) -> Rows:
        """What bakes, on this machine's GPU or its processors."""
        if self._device == "numba":
            return NumbaRows(laid)
        from scan2sim.texturing.bake.blend_torch import TorchRows

        return TorchRows(laid, self._device)

    def _add_photo(self, i: int, rows: Rows, mine: I64, faces: I64) -> int:
        """Add what photo `i` says of the page's faces `mine`, the mesh's `faces`; returns the texels it sees."""
        photo = self.photos.get(i)
        if photo is None:
            return 0
        view = self._views[i]
        share = self._share(i)[self._mesh.faces[faces]] if self._fade else self._alone(i, faces)
        share[self._sign[faces]] = 1.0  # photos of a plate have been chosen to agree: all give its detail
        picture = Picture(*photo.levels, photo.low, self._mask(i, view), self._warp(i), self._exposures.of(view))
        source = Source(picture, eye(view.camera, view.T_world_cam), self._occlusion(i))
        weighing = self._weighing._replace(feather=self._weighing.feather * view.camera.width)
        return rows.add(mine, np.ascontiguousarray(share, np.float32), source, weighing)

    def name(self, i: int) -> str:
        """Of view `i`."""
        return self._views[i].name

    def _alone(self, i: int, faces: I64) -> F32:
        return np.repeat((self._choice.detail_view[faces] == i).astype(np.float32)[:, None], 3, axis=1)

    def _read_occlusion(self, i: int) -> Occlusion:
        """A view's depth map, and the least ranges around its pixels."""
        view, band = self._views[i], self._weighing.band
        depth = load_depth_map(self._depth_file(i), view.camera, view.T_world_cam)
        reach = round(band * depth.camera.width / view.camera.width) if band > 0 else 1

        def least(pixels: int) -> F32:
            return np.asarray(cv2.erode(depth.range, np.ones((2 * pixels + 1, 2 * pixels + 1))), np.float32)

        near = least(1)
        return Occlusion(*depth.ranges, near, near if reach == 1 else least(reach), reach)


def best_device() -> str:
    """The device that "auto" stands for here."""
    if shutil.which("nvidia-smi") is None or missing("torch"):
        return "numba"
    import torch

    return "cuda" if torch.cuda.is_available() else "numba"


def shares(faces: I32, detail_view: I32, vertices: int, views: int) -> Callable[[int], F32]:
    """How much of the detail a view is to give at every vertex: its share of the labelled faces around.

    Returns:
        view index to (V,) float32.
    """
    seen = np.flatnonzero(detail_view >= 0)
    at, of = faces[seen].ravel(), np.repeat(detail_view[seen], 3)
    count = sp.csc_array((np.ones(len(at), np.float32), (at, of)), shape=(vertices, views))
    valence = np.maximum(np.bincount(at, minlength=vertices), 1).astype(np.float32)

    def share(i: int) -> F32:
        out = np.zeros(vertices, np.float32)
        column = slice(count.indptr[i], count.indptr[i + 1])
        out[count.indices[column]] = count.data[column]
        return out / valence

    return share
