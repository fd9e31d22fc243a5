"""Renderer of textured meshes by ray casting: perspective, fisheye, panoramic and orthographic views.

Used to score textures against held-out photos, and for the images of the report.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, F64, I32, U8, Bools, Camera, Colour, Mesh

RAY_CHUNK = 500_000
"""Number of rays cast at a time, to bound memory."""
PAGES_MAX_BYTES = 400_000_000
"""Bytes of decoded pages kept in memory: a tile's pages are decoded once, not once per view."""
SKY_RGB = (200, 214, 230)
"""Colour of the sky of worlds without photos of it."""
SUN_DIRECTION = np.array([0.45, 0.3, 0.84])

Rays = Callable[[F64, F64], tuple[F64, F64]]
"""Function from columns and rows (N,) of an image, pixels, to origins and directions (N, 3) of the rays."""


@dataclass(frozen=True)
class Body:
    """A mesh to be rendered, with its textures or colours.

    Attributes:
        mesh: with `uv` and `page` if it has `pages`.
        pages: texture images (RGB) of the mesh's pages; their colour source masks `page_<i>_seen.png` are read as well.
        colour: (F, 3) or (3,) uint8, colour of the faces if there are no pages.
    """

    mesh: Mesh
    pages: tuple[Path, ...] = ()
    colour: U8 | tuple[int, int, int] = (200, 200, 200)


@dataclass(frozen=True)
class Image:
    """A rendered image; arrays are (H, W).

    Attributes:
        rgb: (H, W, 3) uint8.
        hit: bool, whether the pixel's ray hit a mesh.
        seen: uint8 value of the colour source mask (255 photo, 128 points, 64 inpainted); 0 without textures.
        face: int32 within its body's mesh, -1 where nothing was hit.
        body: int16 index of the body, -1 where nothing was hit.
        range: float32 metres along the ray, inf where nothing was hit.
        barycentric: (H, W, 2) float32 weights of the face's second and third corner.
    """

    rgb: U8
    hit: Bools
    seen: U8
    face: I32
    body: npt.NDArray[np.int16]
    range: F32
    barycentric: F32


def placed(folder: Path, offset: tuple[float, float, float]) -> Body:
    """A textured mesh of a tile, moved by the tile's offset in the world."""
    body = textured(folder)
    mesh: Mesh = body.mesh
    return replace(body, mesh=replace(mesh, vertices=(mesh.vertices + np.asarray(offset)).astype(np.float32)))


def textured(folder: Path) -> Body:
    """Load a body from a folder written by the step `texture` (`mesh.npz`, `page_<i>.png`)."""
    mesh = Mesh.load(folder / "mesh.npz")
    count = 0 if mesh.page is None or not len(mesh) else int(mesh.page.max()) + 1
    return Body(mesh, tuple(folder / f"page_{i}.png" for i in range(count)))


class _Hits(NamedTuple):
    """First hits of N rays: arrays (N,) as in `Image`."""

    face: I32
    body: npt.NDArray[np.int16]
    range: F32
    barycentric: F32


class _Page(NamedTuple):
    """A texture page (H, W, 3), and its colour source mask (H, W) or None."""

    rgb: U8
    seen: U8 | None

    @property
    def bytes(self) -> int:
        return self.rgb.nbytes + (0 if self.seen is None else self.seen.nbytes)


class Renderer:
    """Renders a set of meshes from any number of cameras.

    Args:
        bodies: meshes to render.
        sky: colour of the pixels of a camera's view without a hit; None: `SKY_RGB`.
    """

    def __init__(self, bodies: Sequence[Body], sky: Colour | None = None) -> None:
        import open3d as o3d

        self.bodies, self.sky = tuple(bodies), sky or SKY_RGB
        self._casting = o3d.t.geometry.RaycastingScene()
        self._body_of: dict[int, int] = {}
        for i, body in enumerate(self.bodies):
            if len(body.mesh):
                key = self._casting.add_triangles(
                    _tensor(body.mesh.vertices),
                    _tensor(body.mesh.faces.astype(np.uint32)),
                )
                self._body_of[int(key)] = i
        self._pages: OrderedDict[Path, _Page] = OrderedDict()

    def view(
        self,
        camera: Camera,
        T_world_cam: F64,
        *,
        background: Colour | None = None,
        shaded: bool = False,
        wireframe: bool = False,
        samples: int = 1,
    ) -> Image:
        """Render the view of a camera.

        Args:
            camera, T_world_cam: intrinsics and pose.
            background: colour of pixels without a hit; None: the sky's.
            shaded: apply Lambertian shading by a fixed sun (for plain colours; textures contain the real light).
            wireframe: draw the edges of triangles.
            samples: rays per pixel in each direction (supersampling); the colour of a pixel whose centre hits a mesh is
                the mean of the rays that hit one. Simulators filter distant textures with mip-maps; one ray per pixel
                would look sharper. All other outputs are those of the ray through the pixel's centre.
        """
        rays = _rays_of(camera, T_world_cam)
        return self._cast(camera.width, camera.height, rays, background or self.sky, shaded, wireframe, samples)

    def covers(self, camera: Camera, T_world_cam: F64) -> float:
        """Share of the pixels of a camera's view whose rays hit a mesh; reads no textures."""
        rays, n, hits = _rays_of(camera, T_world_cam), camera.width * camera.height, 0
        for first in range(0, n, RAY_CHUNK) if self._body_of else ():
            row, column = np.divmod(np.arange(first, min(n, first + RAY_CHUNK), dtype=np.float64), camera.width)
            hits += int((self._intersect(*rays(column, row)).body >= 0).sum())
        return hits / n

    def above(
        self,
        low: npt.ArrayLike,
        high: npt.ArrayLike,
        *,
        width: int = 1600,
        background: Colour = (255, 255, 255),
        shaded: bool = False,
        wireframe: bool = False,
        samples: int = 1,
    ) -> Image:
        """Render an orthographic map of the box from `low` to `high` (3,), x to the right and y up.

        Pixels without a hit get the colour `background`; `range` is measured from 1 m above the box; other arguments
        are as in `view`.
        """
        low, high = np.asarray(low, float), np.asarray(high, float)
        pixel_m = max(high[0] - low[0], 1e-3) / width
        height = max(1, round((high[1] - low[1]) / pixel_m))
        top = high[2] + 1.0

        def rays(column: F64, row: F64) -> tuple[F64, F64]:
            x, y = low[0] + (column + 0.5) * pixel_m, high[1] - (row + 0.5) * pixel_m
            return np.column_stack([x, y, np.full(len(x), top)]), np.broadcast_to([0.0, 0.0, -1.0], (len(x), 3))

        return self._cast(width, height, rays, background, shaded, wireframe, samples)

    def down(self, points: F64) -> Image:
        """Image of the surface straight below each of the points (H, W, 3); `range` is the distance below."""
        height, width = points.shape[:2]
        flat = points.reshape(-1, 3)

        def rays(column: F64, row: F64) -> tuple[F64, F64]:
            origin = flat[(row * width + column).astype(int)]
            return origin, np.broadcast_to([0.0, 0.0, -1.0], origin.shape)

        return self._cast(width, height, rays, (0, 0, 0), shaded=False, wireframe=False, samples=1)

    def nearest(self, points: F32) -> tuple[U8, U8, F32]:
        """Colours (N, 3) and mask values (N,) of the surface nearest to points (N, 3), and distances (N,) in metres."""
        rgb, seen = np.zeros((len(points), 3), np.uint8), np.zeros(len(points), np.uint8)
        distance = np.full(len(points), np.inf, np.float32)
        if not self._body_of:
            return rgb, seen, distance
        points = np.ascontiguousarray(points, np.float32)
        answer = self._casting.compute_closest_points(_tensor(points))
        distance[:] = np.linalg.norm(answer["points"].numpy() - points, axis=1)
        face = answer["primitive_ids"].numpy().astype(np.int32)
        barycentric, which = answer["primitive_uvs"].numpy(), answer["geometry_ids"].numpy()
        for key, i in self._body_of.items():
            index = np.flatnonzero(which == key)
            if len(index):
                rgb[index], seen[index] = self._colour(self.bodies[i], face[index], barycentric[index])
        return rgb, seen, distance

    def closest_points(self, points: F32) -> tuple[F32, F32]:
        """Nearest surface points (N, 3) to points (N, 3), local metres, and unit normals (N, 3) of the faces there.

        Both float32; NaN if there is no mesh.
        """
        if not self._body_of:
            return np.full((len(points), 3), np.nan, np.float32), np.full((len(points), 3), np.nan, np.float32)
        answer = self._casting.compute_closest_points(_tensor(np.asarray(points, np.float32)))
        return answer["points"].numpy(), answer["primitive_normals"].numpy()

    def _cast(
        self,
        width: int,
        height: int,
        rays: Rays,
        background: Colour,
        shaded: bool,
        wireframe: bool,
        samples: int,
    ) -> Image:
        n, shape = width * height, (height, width)
        rgb, seen = np.tile(np.array(background, np.uint8), (n, 1)), np.zeros(n, np.uint8)
        face, which = np.full(n, -1, np.int32), np.full(n, -1, np.int16)
        distance, barycentric = np.full(n, np.inf, np.float32), np.zeros((n, 2), np.float32)
        across, down = _sub_pixels(samples)
        step = max(1, RAY_CHUNK // samples**2)
        for first in range(0, n, step) if self._body_of else ():
            here = slice(first, min(n, first + step))
            row, column = np.divmod(np.arange(here.start, here.stop, dtype=np.float64), width)
            origin, direction = rays(column, row)
            hits = self._intersect(origin, direction)
            face[here], which[here], distance[here], barycentric[here] = hits
            colour, seen[here] = self._shade_hits(hits, direction, shaded, wireframe)
            hit = hits.body >= 0
            colour = colour[hit]
            if samples > 1:
                origin, direction = rays((column[hit, None] + across).ravel(), (row[hit, None] + down).ravel())
                fine = self._intersect(origin, direction)
                colours, _ = self._shade_hits(fine, direction, shaded, wireframe)
                colour = _mean(colours, fine.body >= 0, colour)
            rgb[here][hit] = colour
        return Image(
            rgb.reshape(*shape, 3), (which >= 0).reshape(shape), seen.reshape(shape), face.reshape(shape),
            which.reshape(shape), distance.reshape(shape), barycentric.reshape(*shape, 2),
        )  # fmt: skip

    def _intersect(self, origin: F64, direction: F64) -> _Hits:
        """First hits of rays with origins and directions (N, 3); rays with a NaN direction hit nothing."""
        cast, known = np.concatenate([origin, direction], axis=1, dtype=np.float32), np.isfinite(direction).all(axis=1)
        cast[~known] = 0
        answer = self._casting.cast_rays(_tensor(cast))
        t = answer["t_hit"].numpy()
        hit = np.isfinite(t) & known
        lookup = np.full(max(self._body_of) + 1, -1, np.int16)
        lookup[list(self._body_of)] = list(self._body_of.values())
        face, body = np.full(len(t), -1, np.int32), np.full(len(t), -1, np.int16)
        face[hit] = answer["primitive_ids"].numpy()[hit].astype(np.int32)
        body[hit] = lookup[answer["geometry_ids"].numpy()[hit]]
        barycentric = np.where(hit[:, None], answer["primitive_uvs"].numpy(), 0).astype(np.float32)
        return _Hits(face, body, np.where(hit, t, np.inf).astype(np.float32), barycentric)

    def _shade_hits(self, hits: _Hits, direction: F64, shaded: bool, wireframe: bool) -> tuple[U8, U8]:
        """Colours (N, 3) and mask values (N,) at hits; black and 0 for rays without a hit."""
        rgb, seen = np.zeros((len(hits.body), 3), np.uint8), np.zeros(len(hits.body), np.uint8)
        for i, body in enumerate(self.bodies):
            index = np.flatnonzero(hits.body == i)
            if len(index):
                rgb[index], seen[index] = self._colour(body, hits.face[index], hits.barycentric[index])
                if shaded:
                    rgb[index] = _shade(body.mesh, hits.face[index], direction[index], rgb[index])
        if wireframe:
            index = np.flatnonzero(hits.body >= 0)
            size = np.linalg.norm(direction[index], axis=1)
            width = 0.0012 * hits.range[index] * size + 0.002
            edge = self._edge_distance(hits.body[index], hits.face[index], hits.barycentric[index]) < width
            rgb[index[edge]] = (rgb[index[edge]] * 0.35).astype(np.uint8)
        return rgb, seen

    def _colour(self, body: Body, face: I32, barycentric: F32) -> tuple[U8, U8]:
        if not body.pages:
            colour = np.asarray(body.colour, np.uint8)
            return (colour[face] if colour.ndim == 2 else np.tile(colour, (len(face), 1))), np.zeros(
                len(face), np.uint8
            )
        assert body.mesh.uv is not None and body.mesh.page is not None
        corners = body.mesh.uv[face]
        b = barycentric
        uv = corners[:, 0] * (1 - b.sum(axis=1, keepdims=True)) + corners[:, 1] * b[:, :1] + corners[:, 2] * b[:, 1:]
        page = body.mesh.page[face]
        rgb, seen = np.empty((len(face), 3), np.uint8), np.empty(len(face), np.uint8)
        # pages in memory come first: in a fixed order, each would be evicted just before its next use
        for k in sorted(np.unique(page).tolist(), key=lambda k: body.pages[k] not in self._pages):
            on = np.flatnonzero(page == k)
            rgb[on], seen[on] = _sample(*self._page(body.pages[k]), uv[on])
        return rgb, seen

    def _page(self, path: Path) -> _Page:
        """A page, read or from memory; the least recently used ones are evicted."""
        page = self._pages.pop(path, None) or _read(path)
        self._pages[path] = page
        while len(self._pages) > 1 and sum(p.bytes for p in self._pages.values()) > PAGES_MAX_BYTES:
            self._pages.popitem(last=False)
        return page

    def _edge_distance(self, which: npt.NDArray[np.int16], face: I32, barycentric: F32) -> F32:
        """Distance (N,) in metres from a hit to the nearest edge of its triangle."""
        out = np.empty(len(face), np.float32)
        for i, body in enumerate(self.bodies):
            on = which == i
            c = body.mesh.corners[face[on]] if on.any() else np.zeros((0, 3, 3), np.float32)
            doubled = np.linalg.norm(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), axis=1)
            weights = np.column_stack([1 - barycentric[on].sum(axis=1), barycentric[on]])
            opposite = np.linalg.norm(c[:, [2, 0, 1]] - c[:, [1, 2, 0]], axis=2)
            out[on] = (weights * doubled[:, None] / np.maximum(opposite, 1e-9)).min(axis=1)
        return out


def _sub_pixels(samples: int) -> tuple[F64, F64]:
    """Offsets (samples^2,) across and down of a regular grid within a pixel, relative to its centre, in pixels."""
    offset = (np.arange(samples) + 0.5) / samples - 0.5
    down, across = np.meshgrid(offset, offset, indexing="ij")
    return across.ravel(), down.ravel()


def _mean(colours: U8, hit: Bools, centre: U8) -> U8:
    """Mean colours (N, 3) per pixel of its S samples (N * S, 3) that `hit` (N * S,); `centre` (N, 3) if none did."""
    pixels, each = len(centre), len(hit) // max(1, len(centre))
    count = hit.reshape(pixels, each, 1).sum(axis=1)
    total = (colours * hit[:, None]).reshape(pixels, each, 3).sum(axis=1, dtype=np.float32)
    return np.where(count > 0, np.round(total / np.maximum(count, 1)), centre).astype(np.uint8)


def _tensor(array: npt.NDArray[Any]) -> Any:
    import open3d as o3d

    return o3d.core.Tensor(np.ascontiguousarray(array))  # Open3D's stubs don't accept typed arrays


def _rays_of(camera: Camera, T_world_cam: F64) -> Rays:
    """Rays of a posed camera's pixels."""
    from scan2sim.pipeline.camera.models import ray_origins, unproject

    rotation, centre = np.asarray(T_world_cam)[:3, :3], np.asarray(T_world_cam)[:3, 3]

    def rays(column: F64, row: F64) -> tuple[F64, F64]:
        uv = np.column_stack([column, row])
        return centre + ray_origins(camera, uv) @ rotation.T, unproject(camera, uv) @ rotation.T

    return rays


def _read(path: Path) -> _Page:
    """Read a page and its colour source mask."""
    import cv2

    page = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if page is None:
        raise InputError(path, "can't be read as an image", "Run again with `--from texture`")
    seen = path.with_name(f"{path.stem}_seen.png")
    mask: Any = cv2.imread(str(seen), cv2.IMREAD_GRAYSCALE) if seen.is_file() else None
    if mask is not None:  # the nearest texel of a hit on a chart's border may lie in the padding around the chart
        mask = np.where(mask == 0, cv2.dilate(mask, np.ones((3, 3), np.uint8)), mask)
    return _Page(np.asarray(cv2.cvtColor(page, cv2.COLOR_BGR2RGB, page), np.uint8), mask)


def _sample(page: U8, mask: U8 | None, uv: F32) -> tuple[U8, U8]:
    """Bilinear colours (N, 3) of a page, and the nearest value (N,) of its mask, at uv (N, 2), origin lower left."""
    from scan2sim.pipeline.camera.image_sampling import page_colours

    rgb = np.round(page_colours(page, uv)).astype(np.uint8)
    if mask is None:
        return rgb, np.zeros(len(uv), np.uint8)
    height, width = mask.shape
    column = np.clip(np.round(uv[:, 0] * width - 0.5), 0, width - 1).astype(np.int32)
    row = np.clip(np.round((1 - uv[:, 1]) * height - 0.5), 0, height - 1).astype(np.int32)
    return rgb, mask[row, column]


def _shade(mesh: Mesh, face: I32, direction: F64, rgb: U8) -> U8:
    """Lambertian shading by a fixed sun and sky; back faces are lit like front faces."""
    c = mesh.corners[face]
    normal = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]).astype(np.float64)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    normal *= np.where(np.einsum("ij,ij->i", normal, direction) > 0, -1.0, 1.0)[:, None]
    light = (
        0.35
        + 0.2 * (0.5 + 0.5 * normal[:, 2])
        + 0.5 * np.maximum(0, normal @ (SUN_DIRECTION / np.linalg.norm(SUN_DIRECTION)))
    )
    return np.clip(rgb * light[:, None], 0, 255).astype(np.uint8)


def look_at(eye: npt.ArrayLike, target: npt.ArrayLike) -> F64:
    """Pose (4, 4) of an upright camera at `eye` that looks towards `target` (both (3,), local coordinates)."""
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(forward, right), forward, eye
    return pose


def pinhole(width: int, height: int, *, field: float = 70.0) -> Camera:
    """A pinhole camera with a horizontal field of view of `field` degrees."""
    f = width / 2 / math.tan(math.radians(field) / 2)
    return Camera("pinhole", width, height, f, f, (width - 1) / 2, (height - 1) / 2)
