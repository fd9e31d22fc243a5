"""Real-time rendering of a finished world on one CPU core: triangle rasterization with a depth buffer, no ray casting.

It is fast because triangles are grouped into compact clusters of some dozens, drawn front to back: clusters outside the
view frustum, or occluded by what is already drawn, are skipped. Textures have mip maps; the level is chosen for each
triangle by its size in the image.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from scan2sim.pipeline.core.types import F32, F64, I32, U8, Camera
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds.textured_mesh import Textured

CLUSTER_TRIANGLES_MAX = 64
"""Maximum number of triangles in a cluster."""
NEAR_PLANE_M = 0.1
"""Distance of the near clipping plane."""
MIP_LEVELS = 6
"""Number of mip map levels of a texture, each half the size of the one before."""
EDGE_MARGIN_PX = np.float32(1e-3)
"""Margin by which triangles are extended, so that no gap remains between neighbours."""
SKY_RGB = (200, 214, 230)
U16 = npt.NDArray[np.uint16]
U32 = npt.NDArray[np.uint32]


@dataclass(frozen=True)
class World:
    """Textured triangles in clusters; C clusters, F triangles, V vertices, P texture pages.

    Attributes:
        positions: (V, 3) vertex positions, metres.
        first_vertex, first_face: (C + 1,) offsets of each cluster.
        corners: (F, 3) vertex indices within the cluster.
        texels: (F, 3, 2) columns and rows of the corners on their page.
        page: (F,) texture page.
        spheres: (C, 4) bounding spheres: centre and radius, metres.
        pages: all mip levels of all pages as 0xBBGGRR, concatenated.
        sizes: (P, MIP_LEVELS, 3) offset into `pages`, columns and rows of each level.
    """

    positions: F32
    first_vertex: I32
    first_face: I32
    corners: U16
    texels: F32
    page: I32
    spheres: F32
    pages: U32
    sizes: I32


def build_world(shapes: Iterable[tuple[Textured, tuple[float, float, float]]]) -> World:
    """Build clusters from textured meshes and their offsets from the world's origin, metres.

    Raises:
        InputError: a texture page can't be read.
    """
    positions, faces, uvs, pages, files, count = [], [], [], [], list[Path](), 0
    for shape, offset in shapes:
        assert shape.mesh.uv is not None and shape.mesh.page is not None
        positions.append(shape.mesh.vertices + np.asarray(offset, np.float32))
        faces.append(shape.mesh.faces + count)
        uvs.append(shape.mesh.uv)
        pages.append(shape.mesh.page + len(files))
        files += shape.pages
        count += len(shape.mesh.vertices)
    pixels, sizes = _pages(files)
    page, uv = np.concatenate(pages).astype(np.int32), np.concatenate(uvs).astype(np.float32)
    texels = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1) * sizes[page, 0, 1:].astype(np.float32)[:, None]
    return _build_clusters(
        np.concatenate(positions).astype(np.float32), np.concatenate(faces), texels, page, pixels, sizes
    )


def _pages(files: list[Path]) -> tuple[U32, I32]:
    """`World.pages` and `World.sizes`."""
    import cv2

    parts, sizes, start = [], np.zeros((len(files), MIP_LEVELS, 3), np.int32), 0
    for i, file in enumerate(files):
        page = image.read_rgb(file)
        for level in range(MIP_LEVELS):
            height, width = page.shape[:2]
            sizes[i, level] = start, width, height
            parts.append(_pack_rgb(page).ravel())
            start += width * height
            half = max(1, width // 2), max(1, height // 2)
            page = np.asarray(cv2.resize(page, half, interpolation=cv2.INTER_AREA), np.uint8)
    return np.concatenate(parts), sizes


def _pack_rgb(rgb: U8) -> U32:
    """Pack RGB (H, W, 3) into (H, W) integers 0xBBGGRR."""
    packed = np.zeros((*rgb.shape[:2], 4), np.uint8)
    packed[..., :3] = rgb
    return packed.view("<u4")[..., 0]


def _build_clusters(positions: F32, faces: I32, texels: F32, page: I32, pages: U32, sizes: I32) -> World:
    order, first_face = _split_clusters(positions[faces].mean(axis=1))
    faces, texels, page = faces[order], texels[order], page[order]
    vertices, corners, first_vertex, spheres = [], [], [0], []
    for a, b in pairwise(first_face):
        used, index = np.unique(faces[a:b], return_inverse=True)
        own = positions[used]
        middle = (own.min(axis=0) + own.max(axis=0)) / 2
        spheres.append((*middle, np.linalg.norm(own - middle, axis=1).max()))
        vertices.append(own)
        corners.append(index.reshape(-1, 3))
        first_vertex.append(first_vertex[-1] + len(own))
    return World(
        np.concatenate(vertices), np.asarray(first_vertex, np.int32), first_face,
        np.concatenate(corners).astype(np.uint16), np.ascontiguousarray(texels), page,
        np.asarray(spheres, np.float32), pages, sizes,
    )  # fmt: skip


def _split_clusters(centroids: F32) -> tuple[npt.NDArray[np.intp], I32]:
    """Order of triangles by cluster, and cluster offsets; clusters are halved across their longest side."""
    found: list[npt.NDArray[np.intp]] = []
    left = [np.arange(len(centroids))]
    while left:
        index = left.pop()
        if len(index) <= CLUSTER_TRIANGLES_MAX:
            found.append(index)
            continue
        across = centroids[index, np.ptp(centroids[index], axis=0).argmax()]
        half = len(index) // 2
        partitioned = index[np.argpartition(across, half)]
        left += [partitioned[half:], partitioned[:half]]
    return np.concatenate(found), np.cumsum([0, *map(len, found)]).astype(np.int32)


class WorldRenderer:
    """Renders views of a world; not thread-safe."""

    def __init__(self, seen: World, camera: Camera) -> None:
        """`camera`: a pinhole camera."""
        self._world, self._camera = seen, camera
        shape = camera.height, camera.width
        self._depth, self._colour = np.zeros(shape, np.float32), np.zeros(shape, np.uint32)
        self._sky = int(_pack_rgb(np.array(SKY_RGB, np.uint8).reshape(1, 1, 3))[0, 0])
        self._vertices = np.zeros((3 * CLUSTER_TRIANGLES_MAX, 6), np.float32)

    def view(self, T_world_cam: F64) -> U8:
        """Render an image (H, W, 3), RGB, from a camera pose."""
        import cv2

        seen, camera = self._world, self._camera
        rotation = T_world_cam[:3, :3].T
        matrix = np.column_stack([rotation, -rotation @ T_world_cam[:3, 3]]).astype(np.float32)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        self._depth.fill(0)
        self._colour.fill(self._sky)
        order = _frustum_cull(seen.spheres, matrix, lens, camera.width, camera.height)
        _draw(
            order, seen.positions, seen.first_vertex, seen.first_face, seen.corners, seen.texels, seen.page,
            seen.spheres, seen.pages, seen.sizes, matrix, lens, self._vertices, self._depth, self._colour,
        )  # fmt: skip
        packed = self._colour.view(np.uint8).reshape(camera.height, camera.width, 4)
        return np.asarray(cv2.cvtColor(packed, cv2.COLOR_RGBA2RGB), np.uint8)


@njit(cache=True, nogil=True)
def _frustum_cull(spheres: F32, matrix: F32, lens: F32, width: int, height: int) -> I32:
    """Clusters that intersect the view frustum, nearest first."""
    fx, fy, cx, cy = lens
    left, right = -cx / fx, (width - 1 - cx) / fx
    top, bottom = -cy / fy, (height - 1 - cy) / fy
    slants = (
        np.sqrt(1 + left * left), np.sqrt(1 + right * right), np.sqrt(1 + top * top), np.sqrt(1 + bottom * bottom),
    )  # fmt: skip
    found = np.empty(len(spheres), np.int32)
    near = np.empty(len(spheres), np.float32)
    count = 0
    for i in range(len(spheres)):
        p = spheres[i]
        x = matrix[0, 0] * p[0] + matrix[0, 1] * p[1] + matrix[0, 2] * p[2] + matrix[0, 3]
        y = matrix[1, 0] * p[0] + matrix[1, 1] * p[1] + matrix[1, 2] * p[2] + matrix[1, 3]
        z = matrix[2, 0] * p[0] + matrix[2, 1] * p[1] + matrix[2, 2] * p[2] + matrix[2, 3]
        r = p[3]
        if z + r < NEAR_PLANE_M or x - left * z < -r * slants[0] or x - right * z > r * slants[1]:
            continue
        if y - top * z < -r * slants[2] or y - bottom * z > r * slants[3]:
            continue
        found[count] = i
        near[count] = z - r
        count += 1
    return found[:count][np.argsort(near[:count])]


@njit(cache=True, nogil=True, fastmath=True)
def _draw(
    order: I32, positions: F32, first_vertex: I32, first_face: I32, corners: U16, texels: F32, page: I32, spheres: F32,
    pages: U32, sizes: I32, matrix: F32, lens: F32, seen: F32, depth: F32, colour: U32,
) -> None:  # fmt: skip
    """Draw clusters in the given order; `depth` holds 1 / z, 0 where nothing is drawn.

    `seen` is a buffer for a cluster's vertices: x, y and z in the camera frame; column, row and 1 / z in the image.
    """
    fx, fy, cx, cy = lens
    near = np.float32(NEAR_PLANE_M)
    fan = np.empty((4, 5), np.float32)
    for cluster in order:
        if _occluded(spheres[cluster], matrix, lens, depth):
            continue
        first = first_vertex[cluster]
        for i in range(first, first_vertex[cluster + 1]):
            p0, p1, p2, n = positions[i, 0], positions[i, 1], positions[i, 2], i - first
            x = matrix[0, 0] * p0 + matrix[0, 1] * p1 + matrix[0, 2] * p2 + matrix[0, 3]
            y = matrix[1, 0] * p0 + matrix[1, 1] * p1 + matrix[1, 2] * p2 + matrix[1, 3]
            z = matrix[2, 0] * p0 + matrix[2, 1] * p1 + matrix[2, 2] * p2 + matrix[2, 3]
            inverse = np.float32(1) / z
            seen[n, 0], seen[n, 1], seen[n, 2] = x, y, z
            seen[n, 3], seen[n, 4], seen[n, 5] = fx * x * inverse + cx, fy * y * inverse + cy, inverse
        for f in range(first_face[cluster], first_face[cluster + 1]):
            i, j, k = corners[f, 0], corners[f, 1], corners[f, 2]
            behind = (seen[i, 2] < near) + (seen[j, 2] < near) + (seen[k, 2] < near)
            if behind == 0:
                _draw_triangle(
                    seen[i, 3], seen[i, 4], seen[i, 5], seen[j, 3], seen[j, 4], seen[j, 5],
                    seen[k, 3], seen[k, 4], seen[k, 5], texels[f, 0, 0], texels[f, 0, 1], texels[f, 1, 0],
                    texels[f, 1, 1], texels[f, 2, 0], texels[f, 2, 1], page[f], sizes, pages, depth, colour,
                )  # fmt: skip
            elif behind < 3:
                count = _clip_near(seen, corners[f], texels[f], lens, near, fan)
                a = fan[0]
                for m in range(2, count):
                    b, c = fan[m - 1], fan[m]
                    _draw_triangle(
                        a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2], a[3], a[4], b[3], b[4], c[3], c[4],
                        page[f], sizes, pages, depth, colour,
                    )  # fmt: skip


@njit(cache=True, nogil=True, fastmath=True)
def _occluded(sphere: F32, matrix: F32, lens: F32, depth: F32) -> bool:
    """Occlusion test: whether everything already drawn in the cluster's screen rectangle is nearer than the cluster."""
    x = matrix[0, 0] * sphere[0] + matrix[0, 1] * sphere[1] + matrix[0, 2] * sphere[2] + matrix[0, 3]
    y = matrix[1, 0] * sphere[0] + matrix[1, 1] * sphere[1] + matrix[1, 2] * sphere[2] + matrix[1, 3]
    z = matrix[2, 0] * sphere[0] + matrix[2, 1] * sphere[1] + matrix[2, 2] * sphere[2] + matrix[2, 3]
    front = z - sphere[3]
    if front < NEAR_PLANE_M:
        return False
    inverse = np.float32(1) / front
    extent = sphere[3] * inverse
    height, width = depth.shape
    left, right = min(x * inverse, x / z) - extent, max(x * inverse, x / z) + extent
    top, bottom = min(y * inverse, y / z) - extent, max(y * inverse, y / z) + extent
    first, last = max(0, int(lens[0] * left + lens[2])), min(width - 1, int(lens[0] * right + lens[2]) + 1)
    for row in range(max(0, int(lens[1] * top + lens[3])), min(height, int(lens[1] * bottom + lens[3]) + 2)):
        for column in range(first, last + 1):
            if depth[row, column] < inverse:
                return False
    return True


@njit(cache=True, nogil=True, fastmath=True)
def _clip_near(seen: F32, corners: U16, texels: F32, lens: F32, near: np.float32, fan: F32) -> int:
    """Clip a triangle at the near plane into `fan`: corners as column, row, 1 / z and texel; returns their number."""
    count = 0
    for k in range(3):
        m = (k + 1) % 3
        p, q = seen[corners[k]], seen[corners[m]]
        if p[2] >= near:
            fan[count, :3] = p[3:]
            fan[count, 3:] = texels[k]
            count += 1
        if (p[2] >= near) != (q[2] >= near):
            t = (near - p[2]) / (q[2] - p[2])
            fan[count, 0] = lens[0] * (p[0] + t * (q[0] - p[0])) / near + lens[2]
            fan[count, 1] = lens[1] * (p[1] + t * (q[1] - p[1])) / near + lens[3]
            fan[count, 2] = 1 / near
            fan[count, 3:] = texels[k] + t * (texels[m] - texels[k])
            count += 1
    return count


@njit(cache=True, nogil=True, fastmath=True)
def _draw_triangle(
    ax: float, ay: float, az: float, bx: float, by: float, bz: float, cx: float, cy: float, cz: float,
    au: float, av: float, bu: float, bv: float, cu: float, cv: float,
    page: int, sizes: I32, pages: U32, depth: F32, colour: U32,
) -> None:  # fmt: skip
    """Rasterize a triangle with depth test; corners are given as column, row, 1 / z and texel."""
    height, width = depth.shape
    low, high = min(ay, by, cy), max(ay, by, cy)
    west, east = min(ax, bx, cx), max(ax, bx, cx)
    if high < 0 or low > height - 1 or east < 0 or west > width - 1:
        return
    first, last = max(0, int(np.ceil(low))), min(height - 1, int(np.floor(high)))
    if first > last or np.ceil(west) > np.floor(east):
        return
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if area == 0:
        return
    one, far = np.float32(1), np.float32(1e9)
    level = _mip_level(abs((bu - au) * (cv - av) - (cu - au) * (bv - av)), abs(area))
    start, columns, rows = sizes[page, level, 0], sizes[page, level, 1], sizes[page, level, 2]
    shrink = np.float32(1.0 / (1 << level))
    au, av, bu, bv, cu, cv = au * az, av * az, bu * bz, bv * bz, cu * cz, cv * cz
    inverse = one / area
    ty, sy, tx, sx = (by - ay) * inverse, (cy - ay) * inverse, (bx - ax) * inverse, (cx - ax) * inverse
    z_x, z_y = (bz - az) * sy - (cz - az) * ty, (cz - az) * tx - (bz - az) * sx
    u_x, u_y = (bu - au) * sy - (cu - au) * ty, (cu - au) * tx - (bu - au) * sx
    v_x, v_y = (bv - av) * sy - (cv - av) * ty, (cv - av) * tx - (bv - av) * sx
    # change of the column per row along each side; sides that don't span a row are excluded from it
    ab, bc, ca = _slope(ax, ay, bx, by), _slope(bx, by, cx, cy), _slope(cx, cy, ax, ay)
    for row in range(first, last + 1):
        y = np.float32(row)
        left, right = far, -far
        if min(ay, by) <= y <= max(ay, by):
            x = ax + (y - ay) * ab
            left, right = min(left, x), max(right, x)
        if min(by, cy) <= y <= max(by, cy):
            x = bx + (y - by) * bc
            left, right = min(left, x), max(right, x)
        if min(cy, ay) <= y <= max(cy, ay):
            x = cx + (y - cy) * ca
            left, right = min(left, x), max(right, x)
        begin, end = max(0, int(np.ceil(left - EDGE_MARGIN_PX))), min(width - 1, int(np.floor(right + EDGE_MARGIN_PX)))
        x, y = np.float32(begin) - ax, y - ay
        z = az + z_x * x + z_y * y
        u = au + u_x * x + u_y * y
        v = av + v_x * x + v_y * y
        for column in range(begin, end + 1):
            if z > depth[row, column]:
                depth[row, column] = z
                real = shrink / z
                s = min(max(int(u * real), 0), columns - 1)
                t = min(max(int(v * real), 0), rows - 1)
                colour[row, column] = pages[start + t * columns + s]
            z += z_x
            u += u_x
            v += v_x


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _slope(px: float, py: float, qx: float, qy: float) -> Any:
    """Change of the column per row along a side; 0 for a horizontal side."""
    return (qx - px) / (qy - py) if qy != py else np.float32(0)


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _mip_level(texels: Any, pixels: float) -> int:
    """Mip level at which a texel is about as large as a pixel; from the triangle's areas in texels and in pixels."""
    level = 0
    while level < MIP_LEVELS - 1 and texels > np.float32(2) * pixels:
        texels *= np.float32(0.25)
        level += 1
    return level
