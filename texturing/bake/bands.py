"""Texture baking, band by band: memory is bounded by one band of rows and a few photos. Import late: it loads numba."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import scipy.sparse as sp

from scan2sim.pipeline.camera.depth_map import load_depth_map
from scan2sim.pipeline.camera.projection import posed_camera
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.optional_deps import missing
from scan2sim.pipeline.core.step import Report
from scan2sim.pipeline.core.types import F32, I32, I64, Mesh, View
from scan2sim.texturing import texel_map
from scan2sim.texturing.bake.blend_numba import (
    BlendSettings,
    BlendSource,
    NumbaRowBlender,
    Occlusion,
    PageFaces,
    PhotoData,
    RowBlender,
)
from scan2sim.texturing.consistency_result import PhotoConsistency
from scan2sim.texturing.photo_cache import Exposures, PhotoCache
from scan2sim.texturing.texture_page import Page
from scan2sim.texturing.view_selection.choice import Choice

BAND_TEXELS = 3_000_000
"""Texels of a page that are baked at a time, in whole rows."""
DEPTH_MAPS_CACHED = 4
"""Depth maps kept in memory."""


class Baker:
    """Bakes photos onto texture pages, band by band.

    Args:
        mesh: mesh with uv and page.
        views: all views, by index.
        choice: photos selected for every face of the mesh.
        depth_file: maps the index of a view to the file of its depth map.
        exposures: exposure corrections of the photos.
        consistency: masks and warps of the photos.
        settings: weights of the photos; here the feather is a share of a photo's width.
        fade: cross-fade photos over the triangles along a seam.
        device: "numba" or a torch device.

    Attributes:
        used: index of a view to the number of texels that it contributed to.
        photos: the photos; `photos.skipped` lists those that can't be used.
    """

    def __init__(
        self,
        mesh: Mesh,
        views: Sequence[View],
        choice: Choice,
        depth_file: Callable[[int], Path],
        exposures: Exposures,
        consistency: PhotoConsistency,
        *,
        settings: BlendSettings,
        fade: bool,
        device: str,
    ) -> None:
        self._mesh, self._views = mesh, views
        self._settings, self._fade, self._device = settings, fade, device
        self._corners, self._normals = mesh.corners, mesh.face_normal
        self._choice, self._depth_file, self._exposures = choice, depth_file, exposures
        self._warp = consistency.warp
        self._share = detail_shares(mesh.faces, choice.detail_view, len(mesh.vertices), len(views))
        classification = mesh.classification
        self._sign = np.zeros(len(mesh), bool) if classification is None else classification == CODE["road_sign"]
        self._backwards = True
        self._occlusion = lru_cache(maxsize=DEPTH_MAPS_CACHED)(self._read_occlusion)
        self.photos = PhotoCache(views, max(1, settings.band), consistency)
        self.used: dict[int, int] = {}

    def bake(self, faces: I64, width: int, height: int, report: Report) -> Page:
        """A page baked from photos alone; texels that no photo saw stay black and have `seen` 0.

        Args:
            faces: (N,) indices of the faces on the page.
            width, height: size of the page in texels.
            report: progress callback.
        """
        assert self._mesh.uv is not None
        flat = texel_map.corners(self._mesh.uv[faces], width, height)
        owner = texel_map.owners(flat, width, height)
        page = Page(
            np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.uint8), owner, flat,
            self._corners[faces],
        )  # fmt: skip
        low, high = flat[..., 1].min(axis=1), flat[..., 1].max(axis=1)
        rows_per_band = max(1, BAND_TEXELS // width)
        for first in range(0, height, rows_per_band):
            report(first / height)
            rows = slice(first, min(height, first + rows_per_band))
            in_band = np.flatnonzero((high >= rows.start) & (low <= rows.stop))
            if len(in_band):
                self._bake_rows(page, rows, in_band, faces)
        return page

    def _bake_rows(self, page: Page, rows: slice, in_band: I64, faces: I64) -> None:
        """Bake rows of a page; `in_band` are the page's faces (indices into `faces`) that overlap them."""
        flat = page.flat - np.array([0, rows.start], np.float32)
        blender = self._row_blender(PageFaces(page.owner[rows], flat, page.corners, self._normals[faces]))
        candidates = self._choice.view[faces[in_band]]
        order = np.unique(candidates[candidates >= 0]).tolist()
        self._backwards = not self._backwards  # the photos that the previous rows read last are still cached
        for i in reversed(order) if self._backwards else order:
            page_faces = in_band[(candidates == i).any(axis=1)]
            seen = self._add_photo(i, blender, page_faces, faces[page_faces])
            if seen:
                self.used[i] = self.used.get(i, 0) + seen
        blender.resolve(page.rgb[rows], page.seen[rows], self._exposures.white)

    def _row_blender(self, page_faces: PageFaces) -> RowBlender:
        """Blender on the GPU or the CPU, according to the device."""
        if self._device == "numba":
            return NumbaRowBlender(page_faces)
        from scan2sim.texturing.bake.blend_torch import TorchRowBlender

        return TorchRowBlender(page_faces, self._device)

    def _add_photo(self, i: int, blender: RowBlender, page_faces: I64, faces: I64) -> int:
        """Add photo `i` for faces, given by their indices on the page and in the mesh; returns the texels it sees."""
        photo = self.photos.get(i)
        if photo is None:
            return 0
        view = self._views[i]
        share = self._share(i)[self._mesh.faces[faces]] if self._fade else self._share_without_fade(i, faces)
        share[self._sign[faces]] = 1.0  # the photos of a sign panel were selected to agree: all give its detail
        data = PhotoData(*photo.levels, photo.low, photo.mask, self._warp(i), self._exposures.of(view))
        source = BlendSource(data, posed_camera(view.camera, view.T_world_cam), self._occlusion(i))
        settings = self._settings._replace(feather=self._settings.feather * view.camera.width)
        return blender.add(page_faces, np.ascontiguousarray(share, np.float32), source, settings)

    def forget_photos(self) -> None:
        """Free the memory of the photos and depth maps; they are read again when they are needed."""
        self.photos.clear()
        self._occlusion.cache_clear()

    def name(self, i: int) -> str:
        """Name of view `i`."""
        return self._views[i].name

    def _share_without_fade(self, i: int, faces: I64) -> F32:
        """(N, 3) share of the detail at the faces' corners: 1 if view `i` is selected for the face, else 0."""
        return np.repeat((self._choice.detail_view[faces] == i).astype(np.float32)[:, None], 3, axis=1)

    def _read_occlusion(self, i: int) -> Occlusion:
        """A view's depth map, and the smallest ranges around its pixels."""
        view, band = self._views[i], self._settings.band
        depth = load_depth_map(self._depth_file(i), view.camera, view.T_world_cam)
        radius = round(band * depth.camera.width / view.camera.width) if band > 0 else 1

        def smallest_range(pixels: int) -> F32:
            return np.asarray(cv2.erode(depth.range, np.ones((2 * pixels + 1, 2 * pixels + 1))), np.float32)

        near = smallest_range(1)
        return Occlusion(*depth.ranges, near, near if radius == 1 else smallest_range(radius), radius)


def best_device() -> str:
    """The device used for "auto": "cuda" if torch and a GPU are available, else "numba"."""
    if shutil.which("nvidia-smi") is None or missing("torch"):
        return "numba"
    import torch

    return "cuda" if torch.cuda.is_available() else "numba"


def detail_shares(faces: I32, detail_view: I32, vertices: int, views: int) -> Callable[[int], F32]:
    """Share of the detail that a view gives at every vertex: its share of the faces around with a selected view.

    Args:
        faces: (F, 3) vertex indices.
        detail_view: (F,) view selected for each face, -1 for none.
        vertices, views: their numbers.

    Returns:
        Function of a view index that returns (V,) float32.
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
