"""Mesh that another program textured, kept in a tile so that its texture can be baked onto the simplified surface.

One .npz holds the triangles and the encoded texture images. Import late: it loads numba.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numba import njit, prange

from scan2sim.pipeline.core.types import F32, I32, I64, U8, UNCOLOURED, Bools, Frame, Mesh

SUPERSAMPLES_MAX = 8
"""Largest number of samples along each side of a texel that covers many pixels of the source."""
RESOLUTION_QUANTILE = 0.25
"""Share of the area with a finer texture, which determines the resolution of the whole."""


class Texels(NamedTuple):
    """Texels whose area is averaged: face (N,) of each on another mesh, and metres per texel (F, 3) in x and y."""

    face: I32
    per_x: F32
    per_y: F32


@dataclass(frozen=True)
class SourceMesh:
    """A mesh with the texture of the program that made it.

    Attributes:
        mesh: `uv` may lie outside [0, 1] (the image repeats); `page` is -1 for faces without an image.
        colour: (F, 3, 3) uint8 colour of the faces' corners; multiplies the image where there is one. `UNCOLOURED`
            where a face has neither.
        images: encoded images (PNG), uint8.
    """

    mesh: Mesh
    colour: U8
    images: tuple[U8, ...] = ()

    def __len__(self) -> int:
        return len(self.mesh)

    @property
    def coloured(self) -> Bools:
        """(F,) whether the face has an image or a colour."""
        assert self.mesh.page is not None
        return np.asarray((self.mesh.page >= 0) | (self.colour != UNCOLOURED).any(axis=(1, 2)))

    def moved_to(self, frame: Frame) -> SourceMesh:
        """The same mesh in local coordinates of another frame."""
        return replace(self, mesh=self.mesh.moved_to(frame))

    def keep(self, mask: Bools) -> SourceMesh:
        """The faces that `mask` (F,) selects."""
        return replace(self, mesh=self.mesh.keep(mask), colour=self.colour[mask])

    def save(self, path: Path) -> None:
        """Write as .npz."""
        mesh = self.mesh
        assert mesh.uv is not None and mesh.page is not None
        images: dict[str, Any] = {f"image_{i}": image for i, image in enumerate(self.images)}
        frame = np.array([mesh.frame.crs, *map(repr, mesh.frame.origin)])
        np.savez(
            path, frame=frame, vertices=mesh.vertices, faces=mesh.faces, uv=mesh.uv, page=mesh.page,
            colour=self.colour, **images,
        )  # fmt: skip

    @classmethod
    def load(cls, path: Path) -> SourceMesh:
        """Read what `save` wrote."""
        with np.load(path) as data:
            crs, *origin = data["frame"].tolist()
            x, y, z = map(float, origin)
            mesh = Mesh(Frame(crs, (x, y, z)), data["vertices"], data["faces"], uv=data["uv"], page=data["page"])
            count = sum(name.startswith("image_") for name in data.files)
            return cls(mesh, data["colour"], tuple(data[f"image_{i}"] for i in range(count)))

    def resolution_m(self) -> float:
        """Size in metres of the pixels on the surface (of vertex colours, half an edge) where they are fine."""
        mesh = self.mesh
        assert mesh.uv is not None and mesh.page is not None
        area = mesh.face_area.astype(np.float64)
        pixel = np.linalg.norm(np.diff(mesh.corners[:, [0, 1, 2, 0]], axis=1), axis=2).mean(axis=1) / 2
        for k, image in enumerate(self.images):
            on = np.flatnonzero(mesh.page == k)
            flat = mesh.uv[on].astype(np.float64) * _size(image)
            a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
            pixels = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
            pixel[on] = np.sqrt(area[on] / np.maximum(pixels, 1e-6))
        order = np.argsort(pixel)
        share = np.cumsum(area[order])
        at = int(np.searchsorted(share, RESOLUTION_QUANTILE * share[-1])) if len(share) else 0
        return float(pixel[order[min(at, len(order) - 1)]]) if len(order) else 0.0

    def colours(self, face: I32, second: F32, third: F32, texels: Texels | None = None) -> U8:
        """Colours (N, 3) at points on the surface.

        Args:
            face: (N,) face of each point.
            second, third: (N,) barycentric weights of the face's second and third corner.
            texels: average over these texels around the points; None: colours of the points.
        """
        mesh = self.mesh
        assert mesh.uv is not None and mesh.page is not None
        out = np.empty((len(face), 3), np.uint8)
        if texels is None:
            texels = Texels(np.zeros(len(face), np.int32), np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32))
        page = mesh.page[face]
        for k in np.unique(page).tolist():
            image = _decoded(self.images[k]) if k >= 0 else np.full((1, 1, 3), 255, np.uint8)
            at = np.flatnonzero(page == k)
            _sample(
                out, at, face, second, third, *texels, mesh.vertices, mesh.faces, mesh.uv, self.colour, image
            )  # fmt: skip
        return out


def encoded(rgb: U8) -> U8:
    """An image (H, W, 3) as PNG bytes (uint8)."""
    return np.asarray(cv2.imencode(".png", rgb[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]).ravel()


def _decoded(image: U8) -> U8:
    return np.ascontiguousarray(cv2.imdecode(image, cv2.IMREAD_COLOR)[..., ::-1])


def _size(image: U8) -> tuple[int, int]:
    """Width and height of a PNG, from its header."""
    return int.from_bytes(image[16:20].tobytes()), int.from_bytes(image[20:24].tobytes())


@njit(cache=True, parallel=True)
def _sample(
    out: U8,
    at: I64,
    face: I32,
    second: F32,
    third: F32,
    texel_face: I32,
    per_x: F32,
    per_y: F32,
    vertices: F32,
    faces: I32,
    uv: F32,
    colour: U8,
    image: U8,
) -> None:
    """Write the colours of the points `at` (indices), all on faces with the same image."""
    height, width = image.shape[:2]
    for i in prange(len(at)):
        n, f, t = at[i], face[at[i]], texel_face[at[i]]
        # metres per texel -> change of the barycentric weights per texel, from the normal equations of both edges
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        g11 = g12 = g22 = x1 = x2 = y1 = y2 = 0.0
        for k in range(3):
            e1, e2 = np.float64(b[k]) - a[k], np.float64(c[k]) - a[k]
            g11 += e1 * e1
            g12 += e1 * e2
            g22 += e2 * e2
            x1 += e1 * per_x[t, k]
            x2 += e2 * per_x[t, k]
            y1 += e1 * per_y[t, k]
            y2 += e2 * per_y[t, k]
        det = g11 * g22 - g12 * g12
        det = 1.0 / det if det > 1e-20 else 0.0
        sx, tx = (g22 * x1 - g12 * x2) * det, (g11 * x2 - g12 * x1) * det
        sy, ty = (g22 * y1 - g12 * y2) * det, (g11 * y2 - g12 * y1) * det
        u0, v0 = np.float64(uv[f, 0, 0]), np.float64(uv[f, 0, 1])
        us, vs = (uv[f, 1, 0] - u0) * width, (uv[f, 1, 1] - v0) * height  # pixels per unit of the weights
        ut, vt = (uv[f, 2, 0] - u0) * width, (uv[f, 2, 1] - v0) * height
        reach = max(math.hypot(sx * us + tx * ut, sx * vs + tx * vt), math.hypot(sy * us + ty * ut, sy * vs + ty * vt))
        samples = min(SUPERSAMPLES_MAX, max(1, int(math.ceil(reach - 0.25))))
        red = green = blue = 0.0
        for j in range(samples):
            for k in range(samples):
                dx, dy = (k + 0.5) / samples - 0.5, (j + 0.5) / samples - 0.5
                s, w = second[n] + dx * sx + dy * sy, third[n] + dx * tx + dy * ty
                x, y = u0 * width + s * us + w * ut - 0.5, (1 - v0) * height - s * vs - w * vt - 0.5
                x0, y0 = math.floor(x), math.floor(y)
                fx, fy = x - x0, y - y0
                left, right = int(x0 % width), int((x0 + 1) % width)
                top, bottom = int(y0 % height), int((y0 + 1) % height)
                weight = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
                p, q, r, o = image[top, left], image[top, right], image[bottom, left], image[bottom, right]
                red += weight[0] * p[0] + weight[1] * q[0] + weight[2] * r[0] + weight[3] * o[0]
                green += weight[0] * p[1] + weight[1] * q[1] + weight[2] * r[1] + weight[3] * o[1]
                blue += weight[0] * p[2] + weight[1] * q[2] + weight[2] * r[2] + weight[3] * o[2]
        scale = 1.0 / (255.0 * samples * samples)
        first = 1.0 - second[n] - third[n]
        rgb = red, green, blue
        for k in range(3):
            tint = first * colour[f, 0, k] + second[n] * colour[f, 1, k] + third[n] * colour[f, 2, k]
            out[n, k] = np.uint8(min(255.0, max(0.0, rgb[k] * scale * tint + 0.5)))
