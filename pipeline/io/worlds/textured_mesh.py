"""A textured mesh on disk (a folder with `mesh.npz` and `page_<i>.png`), and functions shared by its writers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, I32, Bools, Mesh

PHOTO_FILE, REFLECTANCE_FILE = "photo.npy", "reflectance.npy"


@dataclass(frozen=True)
class Textured:
    """A mesh with its shading normals and texture pages.

    Attributes:
        mesh: with `uv` and `page`.
        normal: (V, 3) float32, unit vertex normals.
        pages: image file of every page, indexed by `mesh.page`.
        photo: (F,) int32 index of the view that gives each face's detail, -1 without one; None: not known.
        reflectance: (V,) float32 in [0, 1], relative reflectance for lidar, in steps of 1/255; None: not known.
    """

    mesh: Mesh
    normal: F32
    pages: tuple[Path, ...]
    photo: I32 | None = None
    reflectance: F32 | None = None

    def __len__(self) -> int:
        return len(self.mesh)

    @property
    def seen(self) -> tuple[Path, ...]:
        """Provenance mask of every page that has one; it gives the source of each texel's colour."""
        masks = (page.with_name(f"{page.stem}_seen.png") for page in self.pages)
        return tuple(mask for mask in masks if mask.is_file())

    @property
    def used_pages(self) -> list[int]:
        """The pages that have faces, ascending."""
        assert self.mesh.page is not None
        return np.unique(self.mesh.page).tolist()

    def on_page(self, page: int) -> Textured:
        """The faces on a page."""
        assert self.mesh.page is not None
        return self.keep(self.mesh.page == page)

    def keep(self, mask: Bools) -> Textured:
        """The faces selected by `mask` (F,); normals stay those of the whole mesh, so that no seam shows."""
        used = np.unique(self.mesh.faces[mask])
        photo = None if self.photo is None else self.photo[mask]
        reflectance = None if self.reflectance is None else self.reflectance[used]
        return replace(self, mesh=self.mesh.keep(mask), normal=self.normal[used], photo=photo, reflectance=reflectance)

    def with_backs(self, mask: Bools) -> Textured:
        """The faces, and those selected by `mask` (F,) again with their other side as front."""
        if not mask.any():
            return self
        backs, mesh = self.keep(mask), self.mesh
        assert mesh.uv is not None and backs.mesh.uv is not None

        def both(front: npt.NDArray[Any] | None, back: npt.NDArray[Any] | None) -> Any:
            return None if front is None or back is None else np.concatenate([front, back])

        return Textured(
            replace(
                mesh,
                vertices=both(mesh.vertices, backs.mesh.vertices),
                faces=both(mesh.faces, backs.mesh.faces[:, ::-1] + np.int32(len(mesh.vertices))),
                density=both(mesh.density, backs.mesh.density),
                uv=both(mesh.uv, backs.mesh.uv[:, ::-1]),
                page=both(mesh.page, backs.mesh.page),
                classification=both(mesh.classification, backs.mesh.classification),
            ),
            both(self.normal, -backs.normal),
            self.pages,
            both(self.photo, backs.photo),
            both(self.reflectance, backs.reflectance),
        )

    def median_reflectance(self) -> float | None:
        """Median reflectance of the surface, each face by its area; None: not known."""
        if self.reflectance is None:
            return None
        of_face = self.reflectance[self.mesh.faces].mean(axis=1)
        order = np.argsort(of_face, kind="stable")
        area = np.cumsum(self.mesh.face_area[order], dtype=np.float64)
        return float(of_face[order[min(np.searchsorted(area, area[-1] / 2), len(order) - 1)]])

    def parts(self, limit: int) -> list[Textured]:
        """Spatially compact parts of at most `limit` triangles: halved along the longest side until small enough."""
        centre = self.mesh.corners.mean(axis=1)

        def halve(index: npt.NDArray[np.intp]) -> list[npt.NDArray[np.intp]]:
            if len(index) <= limit:
                return [index]
            longest_axis = np.ptp(centre[index], axis=0).argmax()
            index = index[np.argsort(centre[index, longest_axis], kind="stable")]
            middle = len(index) // 2
            return halve(index[:middle]) + halve(index[middle:])

        pieces = halve(np.arange(len(self)))
        if len(pieces) == 1:
            return [self]
        return [self.keep(np.isin(np.arange(len(self)), piece)) for piece in pieces]


def read(folder: Path) -> Textured | None:
    """Read a textured mesh; None if it has no faces.

    Raises:
        InputError: no texture coordinates, pages out of range, or a page's image is missing.
    """
    path = folder / "mesh.npz"
    mesh = Mesh.load(path)
    if len(mesh) == 0:
        return None
    if mesh.uv is None or mesh.page is None:
        raise InputError(path, "has no texture coordinates", "Give the mesh that the step `texture` wrote")
    if mesh.page.min() < 0:
        raise InputError(
            path, f"has a face on page {mesh.page.min()}", "Every face must have a page: run the step `texture` again"
        )
    pages = tuple(folder / f"page_{i}.png" for i in range(int(mesh.page.max()) + 1))
    for page in pages:
        if not page.is_file():
            raise InputError(page, "file not found, but mesh.npz has faces on it", "Run the step `texture` again")
    photo = _column(folder / PHOTO_FILE, len(mesh), "faces")
    level = _column(folder / REFLECTANCE_FILE, len(mesh.vertices), "vertices")
    return Textured(
        mesh,
        vertex_normals(mesh),
        pages,
        None if photo is None else np.asarray(photo, np.int32),
        None if level is None else (level / np.float32(255)).astype(np.float32),
    )


def save_reflectance(folder: Path, reflectance: F32) -> None:
    """Write the reflectance of vertices (V,), 0 to 1, of the textured mesh in a folder."""
    np.save(folder / REFLECTANCE_FILE, np.rint(255 * reflectance).astype(np.uint8))


def _column(path: Path, count: int, of: str) -> npt.NDArray[Any] | None:
    """The values of all faces or vertices in a file; None if it doesn't exist."""
    if not path.is_file():
        return None
    values: npt.NDArray[Any] = np.load(path)
    if values.shape != (count,):
        raise InputError(path, f"has {values.shape} {of}, but mesh.npz has {count}", "Export the world again")
    return values


def vertex_normals(mesh: Mesh) -> F32:
    """Unit vertex normals (V, 3), the area-weighted mean of adjacent faces; upwards where that is undefined."""
    c = mesh.corners
    cross = np.repeat(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), 3, axis=0)
    at, n = mesh.faces.ravel(), len(mesh.vertices)
    total = np.stack([np.bincount(at, cross[:, k], n) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    unit = np.divide(total, length, out=np.zeros_like(total), where=length > 1e-12)
    unit[length[:, 0] <= 1e-12] = (0, 0, 1)
    return unit.astype(np.float32)


def unique_uv(uv: F32) -> tuple[F32, I32]:
    """Index texture coordinates per corner (F, 3, 2): unique ones (T, 2) and indices (F, 3) into them."""
    # a pair of float32 is one 64-bit word, and sorting words is many times faster than sorting rows
    words, index = np.unique(np.ascontiguousarray(uv, np.float32).view(np.uint64).ravel(), return_inverse=True)
    return words.view(np.float32).reshape(-1, 2), index.reshape(-1, 3).astype(np.int32)
