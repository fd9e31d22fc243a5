"""Pictures of a camera that stands still: what stands is rendered once, what moves is cast where it is.

Light is as in `scene`, and simpler: openness to the sky is guessed, vehicles shade the ground and not each other. Paint
and glass of vehicles mirror the sky a little.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from scan2sim.data_samples import materials, signs, sky
from scan2sim.data_samples.paints import Material
from scan2sim.data_samples.photos import directions
from scan2sim.data_samples.scene import Hits, caster, illuminated, occluded, srgb, struck
from scan2sim.data_samples.shapes import Part
from scan2sim.data_samples.town import lit
from scan2sim.pipeline.core.types import F32, F64, I32, U8, Bools, Camera

LENS = 0.55
"""Pixels, standard deviation of a lens's blur."""
NO_ROAD = np.array([3.2, -1e6, 0.0])
NEAR = 0.3
MIRRORS = {Material.CAR_BODY: 0.04, Material.CAR_END: 0.04, Material.CAR_GLASS: 0.10, Material.WINDOW: 0.08}
"""Share of the light that comes from ahead which materials of vehicles mirror."""


@dataclass(frozen=True)
class Light:
    """The light of an hour.

    Attributes:
        sun: (3,) unit, towards it.
        sun_strength, sky_strength: as in `layout.Style`.
        cloudiness: share of the sky.
        exposure: mean of the pictures of what stands, of 1, that the camera aims at.
    """

    sun: F64
    sun_strength: float
    sky_strength: float
    cloudiness: float
    exposure: float = 0.45


class Body:
    """A thing's mesh that rays can be cast at, in its own coordinates; x forwards."""

    def __init__(self, part: Part) -> None:
        self.part = lit(part)
        self.low, self.high = part.vertices.min(axis=0), part.vertices.max(axis=0)
        self.mirror = np.zeros(256, np.float32)
        for material, share in MIRRORS.items():
            self.mirror[material] = share

    @cached_property
    def caster(self) -> Any:
        """Of the mesh."""
        return caster(self.part)


@dataclass(frozen=True)
class Piece:
    """A body at its place (3,), turned by `heading` about z."""

    body: Body
    place: F64
    heading: float


@dataclass(frozen=True)
class Actor:
    """A thing that is to be found: a car of one piece, a train of several.

    Attributes:
        label: its class, of `fleet.CLASSES`.
        track: the same in all frames.
        speed: m/s.
    """

    label: str
    track: int
    pieces: tuple[Piece, ...]
    speed: float = 0.0


@dataclass(frozen=True)
class Seen:
    """What a picture shows of an actor.

    Attributes:
        box: x0, y0, x1, y1, pixels: all of it that lies within the picture, whether hidden or not; edges of pixels, so
            that a whole picture is 0, 0, W, H.
        visible: share of its pixels within the picture that nothing hides.
        pixels: how many are seen.
    """

    actor: Actor
    box: tuple[int, int, int, int]
    visible: float
    pixels: int


@dataclass(frozen=True)
class Frame:
    """A picture (H, W, 3), what it shows, and of which actor each pixel is, (H, W), -1: of none."""

    rgb: U8
    seen: list[Seen]
    owner: I32


@dataclass(frozen=True)
class Backdrop:
    """What stands, seen by a camera (wider than the pictures, so that they can shake).

    Attributes:
        sunny, shady: (H, W, 3) with the sun, and where something is before it.
        distance: (H, W) metres along the ray, infinite for the sky.
        gain: what the camera multiplies light by.
    """

    camera: Camera
    T_world_cam: F64
    sunny: U8
    shady: U8
    distance: F32
    gain: float


class Stage:
    """What stands, and its light.

    Args:
        part: all that stands.
        seed: of the sky and the land beyond.
    """

    def __init__(self, part: Part, light: Light, seed: int = 0) -> None:
        self.part, self.light, self.seed = lit(part), light, seed
        self._caster = caster(part)
        self._pictures = signs.pictures()

    def clear(self, camera: Camera, T_world_cam: F64, step: int = 16) -> F32:
        """(h, w) distance that some pixels, `step` apart, see."""
        return self._cast(*self._rays(camera, T_world_cam, step))[0].distance.reshape(camera.height // step, -1)

    def backdrop(self, camera: Camera, T_world_cam: F64, samples: int = 2) -> Backdrop:
        """What stands as the camera sees it, by `samples` squared rays a pixel."""
        places = (np.arange(samples) + 0.5) / samples - 0.5
        sunny, shady = np.zeros((2, camera.height * camera.width, 3), np.float32)
        for right in places:
            for down in places:
                origins, rays = self._rays(camera, T_world_cam, 1, (right, down))
                hits, light, shade = self._cast(origins, rays, 1 / camera.fx)
                sunny += light
                shady += shade
        shape = (camera.height, camera.width)
        gain = _exposed(sunny / np.float32(samples**2), self.light.exposure)
        bright, dark = (srgb(x / samples**2 * gain).reshape(*shape, 3) for x in (sunny, shady))
        return Backdrop(camera, T_world_cam, bright, dark, hits.distance.reshape(shape), gain)

    def _rays(
        self, camera: Camera, T_world_cam: F64, step: int, shift: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[F32, F32]:
        v, u = np.mgrid[: camera.height // step * step : step, : camera.width // step * step : step]
        pixels = np.stack([u + shift[0], v + shift[1]], axis=-1).reshape(-1, 2)
        rays = (directions(camera, pixels) @ T_world_cam[:3, :3].T).astype(np.float32)
        return np.broadcast_to(T_world_cam[:3, 3].astype(np.float32), rays.shape), rays

    def _cast(self, origins: F32, rays: F32, angle: float = 0.002) -> tuple[Hits, F32, F32]:
        """Hits of rays (N, 3), and the linear light from there (N, 3), with the sun and without."""
        hits = struck(self._caster, np.concatenate([origins, rays], axis=1))
        at, light = np.flatnonzero(hits.hit), self.light
        sun = light.sun.astype(np.float32)
        size = (angle * hits.distance[at]).astype(np.float32)
        albedo, normal, open_ = self._surface(self.part, hits.face[at], hits.bary[at], size)
        facing = np.maximum(normal @ sun, 0)
        leaf = self.part.material[hits.face[at]] == Material.FOLIAGE
        facing = np.where(leaf, 0.3 + 0.7 * facing, facing).astype(np.float32)
        place = origins[at] + rays[at] * hits.distance[at, None] + 0.02 * normal + 0.012 * sun
        toward = np.concatenate([place, np.broadcast_to(sun, place.shape)], axis=1).astype(np.float32)
        facing[occluded(self._caster, toward)] = 0
        both = np.zeros((2, len(rays), 3), np.float32)
        for which, direct in enumerate((facing, np.zeros_like(facing))):
            both[which, at] = illuminated(albedo, normal, open_, direct, light.sun_strength, light.sky_strength)
        out = np.flatnonzero(~hits.hit)
        axis, ends = np.array([0.0, 1e-4, 0.0]), np.zeros(2)
        beyond = sky.beyond(origins[out], rays[out], light.sun, light.cloudiness, axis, ends, self.seed)
        both[:, out] = beyond * (light.sky_strength / 0.42)
        return hits, both[0], both[1]

    def _surface(self, part: Part, face: Any, bary: F32, size: F32) -> tuple[F32, F32, F32]:
        return materials.surface(
            face, bary, size, part.faces, part.normals, part.uv, part.sky, part.material, part.colour, part.seed,
            part.size, NO_ROAD, self._pictures,
        )  # fmt: skip

    def frame(self, backdrop: Backdrop, actors: list[Actor], size: tuple[int, int], shake: F64 | None = None) -> Frame:
        """The picture with actors in it.

        Args:
            size: width and height.
            shake: (2, 3) from the picture's pixels to the backdrop's; None: from its middle.
        """
        import cv2

        view = View(backdrop, size, middle(backdrop, size) if shake is None else shake)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        sunny, shady = (cv2.warpAffine(x, view.shake, size, flags=flags) for x in (backdrop.sunny, backdrop.shady))
        nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        distance = cv2.warpAffine(backdrop.distance, view.shake, size, flags=nearest)
        dark, dim = self._shade(view, actors, distance)
        rgb = np.where(dark[..., None], shady, sunny)
        if (beside := dim < 1).any():
            rgb[beside] = (rgb[beside] * dim[beside, None]).astype(np.uint8)
        owner = np.full(distance.shape, -1, np.int32)
        hidden = np.zeros((len(actors), *distance.shape), bool)
        near = [(float(np.linalg.norm(p.place - view.origin)), i, p) for i, a in enumerate(actors) for p in a.pieces]
        for _, i, piece in sorted(near, key=lambda x: x[:2]):  # near ones first: what they hide needs no colours
            self._add(view, piece, i, rgb, distance, owner, hidden[i])
        seen = [_seen(actor, hidden[i], owner == i) for i, actor in enumerate(actors)]
        return Frame(cv2.GaussianBlur(rgb, (5, 5), LENS), [s for s in seen if s is not None], owner)

    def _add(self, view: View, piece: Piece, index: int, rgb: U8, distance: F32, owner: I32, whole: Bools) -> None:
        """Cast a piece, and draw it where it is the nearest."""
        body = piece.body
        rect = view.around(corners(piece))
        if rect is None:
            return
        rays = view.rays(rect)
        turn = turned(piece.heading)
        own = np.empty((len(rays), 6), np.float32)
        own[:, :3] = (view.origin - piece.place) @ turn
        own[:, 3:] = rays @ turn.astype(np.float32)
        hits = struck(body.caster, own)
        shape = distance[rect].shape
        whole[rect] |= hits.hit.reshape(shape)
        closer = hits.distance.reshape(shape) < distance[rect]
        at = np.flatnonzero(closer)
        if not len(at):
            return
        distance[rect][closer] = hits.distance[at]
        owner[rect][closer] = index
        rgb[rect][closer] = self._lit(body, hits, at, rays[at], turn, view)

    def _lit(self, body: Body, hits: Hits, at: npt.NDArray[np.intp], rays: F32, turn: F64, view: View) -> U8:
        """(N, 3) colours of what rays hit of a body."""
        light, sun = self.light, self.light.sun.astype(np.float32)
        size = (view.angle * hits.distance[at]).astype(np.float32)
        albedo, normal, open_ = self._surface(body.part, hits.face[at], hits.bary[at], size)
        normal = normal @ turn.T.astype(np.float32)
        facing = np.maximum(normal @ sun, 0)
        out = illuminated(albedo, normal, open_, facing, light.sun_strength, light.sky_strength)
        share = body.mirror[body.part.material[hits.face[at]]][:, None]
        cosine = np.abs(np.einsum("ij,ij->i", rays, normal))[:, None]
        share = np.where(share > 0, share + (1 - share) * (1 - cosine) ** 5, 0)
        up = (rays - 2 * np.einsum("ij,ij->i", rays, normal)[:, None] * normal)[:, 2:]
        mirrored = light.sky_strength * np.where(up > 0, 1.9 - 0.9 * np.clip(up, 0, 1), 0.25)
        glint = np.maximum((rays - 2 * (rays * normal).sum(axis=1)[:, None] * normal) @ sun, 0)[:, None] ** 60
        out = out + share * (mirrored + 4 * light.sun_strength * glint)
        return srgb(out * view.gain)

    def _shade(self, view: View, actors: list[Actor], distance: F32) -> tuple[Bools, F32]:
        """(H, W) what of the ground lies in actors' shade, and how much light is left beneath and beside them."""
        dark, dim = np.zeros(distance.shape, bool), np.ones(distance.shape, np.float32)
        sun = self.light.sun
        for piece in (p for a in actors for p in a.pieces):
            box = corners(piece)
            ground = box.copy()
            ground[:, 2] = piece.place[2]
            wide = piece.place + (ground - piece.place) * 1.4
            rect = view.around(np.concatenate([box, _thrown(box, sun, float(piece.place[2])), wide]))
            if rect is None:
                continue
            low, high = piece.body.low.astype(np.float64), piece.body.high.astype(np.float64)
            own = turned(piece.heading)
            _cover(
                view.rays(rect), distance[rect].ravel(), (view.origin - piece.place) @ own, own, sun @ own, low, high,
                dark[rect], dim[rect],
            )  # fmt: skip
        return dark, dim


class View:
    """A picture's place within a backdrop."""

    def __init__(self, backdrop: Backdrop, size: tuple[int, int], shake: F64) -> None:
        self.shake, self.size = np.asarray(shake, np.float64), size
        whole = np.vstack([self.shake, [0, 0, 1]])
        self._back = np.linalg.inv(whole)
        self._camera, self._pose = backdrop.camera, backdrop.T_world_cam
        self.origin, self.angle, self.gain = backdrop.T_world_cam[:3, 3], 1 / backdrop.camera.fx, backdrop.gain
        c = self._camera
        inverse = np.array([[1 / c.fx, 0, -c.cx / c.fx], [0, 1 / c.fy, -c.cy / c.fy], [0, 0, 1]])
        rays = _pixels(size) @ (self._pose[:3, :3] @ inverse @ whole).T.astype(np.float32)
        rays /= np.sqrt(np.einsum("ijk,ijk->ij", rays, rays))[..., None]
        self._rays = rays

    def rays(self, rect: tuple[slice, slice]) -> F32:
        """(N, 3) unit rays through the pixels of a part."""
        return np.ascontiguousarray(self._rays[rect]).reshape(-1, 3)

    def project(self, places: F64) -> tuple[F64, F64]:
        """Pixels (N, 2) of the picture, and depth (N,), of places (N, 3)."""
        own = (places - self.origin) @ self._pose[:3, :3]
        depth = own[:, 2]
        flat = own[:, :2] / np.maximum(depth, 1e-6)[:, None]
        wide = flat * [self._camera.fx, self._camera.fy] + [self._camera.cx, self._camera.cy]
        return wide @ self._back[:2, :2].T + self._back[:2, 2], depth

    def around(self, places: F64) -> tuple[slice, slice] | None:
        """Rows and columns that a convex thing with these corners (N, 3) may cover; None: none."""
        pixels, depth = self.project(places)
        ahead = depth > NEAR
        if not ahead.any():
            return None
        width, height = self.size
        if ahead.all():
            (x0, y0), (x1, y1) = np.floor(pixels.min(axis=0)) - 1, np.ceil(pixels.max(axis=0)) + 2
        else:
            x0, y0, x1, y1 = 0, 0, width, height
        a, b, c, d = (int(np.clip(v, 0, n)) for v, n in ((x0, width), (x1, width), (y0, height), (y1, height)))
        return (slice(c, d), slice(a, b)) if b > a and d > c else None


@lru_cache(4)
def _pixels(size: tuple[int, int]) -> F32:
    """(H, W, 3) x, y and 1 of each pixel."""
    v, u = np.mgrid[: size[1], : size[0]].astype(np.float32)
    return np.stack([u, v, np.ones_like(u)], axis=-1)


def middle(backdrop: Backdrop, size: tuple[int, int], turn: float = 0.0, aside: npt.ArrayLike = (0.0, 0.0)) -> F64:
    """(2, 3) from a picture's pixels to the backdrop's: turned (radians) about the middle of both, moved (pixels)."""
    c, s = np.cos(turn), np.sin(turn)
    turning = np.array([[c, -s], [s, c]])
    own = (np.array(size) - 1) / 2
    wide = (np.array([backdrop.camera.width, backdrop.camera.height]) - 1) / 2 + np.asarray(aside)
    return np.column_stack([turning, wide - turning @ own])


def wider(camera: Camera, margin: int) -> Camera:
    """The camera with so many more pixels on each side."""
    return replace(
        camera, width=camera.width + 2 * margin, height=camera.height + 2 * margin,
        cx=camera.cx + margin, cy=camera.cy + margin,
    )  # fmt: skip


def _exposed(light: F32, aim: float) -> float:
    """The gain that linear light (N, 3) needs for a picture whose mean, of 1, is `aim`."""
    some, low, high = light[:: max(1, len(light) // 20_000)], 0.05, 20.0
    for _ in range(20):
        gain = float(np.sqrt(low * high))
        low, high = (gain, high) if srgb(some * gain).mean() < 255 * aim else (low, gain)
    return gain


def corners(piece: Piece) -> F64:
    """(8, 3) corners of the box around a piece."""
    low, high = piece.body.low, piece.body.high
    own = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    return own @ turned(piece.heading).T + piece.place


def turned(heading: float) -> F64:
    """(3, 3) from a body's own axes to the world's."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _thrown(box: F64, sun: F64, ground: float) -> F64:
    """(8, 3) where the shade of a box's corners falls, at most 40 metres away."""
    far = np.minimum((box[:, 2] - ground) / max(sun[2], 0.02), 40.0)
    return box - far[:, None] * sun


def _seen(actor: Actor, whole: Bools, own: Bools) -> Seen | None:
    """What is seen of an actor; None: none of it is within the picture."""
    rows, columns = np.flatnonzero(whole.any(axis=1)), np.flatnonzero(whole.any(axis=0))
    if not len(rows):
        return None
    box = (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    pixels = int(own.sum())
    return Seen(actor, box, round(pixels / int(whole.sum()), 4), pixels)


@njit(cache=True)
def _cover(
    rays: npt.NDArray[Any], distance: npt.NDArray[Any], origin: npt.NDArray[Any], turn: npt.NDArray[Any],
    sun: npt.NDArray[Any], low: npt.NDArray[Any], high: npt.NDArray[Any], dark: npt.NDArray[Any],
    dim: npt.NDArray[Any],
) -> None:  # fmt: skip
    """Mark what a box keeps the sun from, and dim what is below and beside it; all but `rays` in the box's axes.

    Args:
        rays, distance: (N, 3), (N,) of pixels, in the world's axes.
        turn: (3, 3) from the box's axes to the world's.
        dark, dim: (h, w), changed.
    """
    w = dark.shape[1]
    for i in range(len(rays)):
        far = distance[i]
        if far > 1e6:
            continue
        x = origin[0] + far * (rays[i, 0] * turn[0, 0] + rays[i, 1] * turn[1, 0])
        y = origin[1] + far * (rays[i, 0] * turn[0, 1] + rays[i, 1] * turn[1, 1])
        z = origin[2] + far * rays[i, 2]
        if z < 0.4:
            beside = max(low[0] - x, x - high[0], low[1] - y, y - high[1])
            if beside < 0.45:
                dim[i // w, i % w] *= 1 - min(max(0.45 - beside, 0.0), 0.55)
        first, last = 0.05, 1e9
        for p, d, a, b in ((x, sun[0], low[0], high[0]), (y, sun[1], low[1], high[1]), (z, sun[2], 0.25, high[2])):
            if abs(d) < 1e-9:
                if p < a or p > b:
                    last = -1.0
                continue
            s, t = (a - p) / d, (b - p) / d
            first, last = max(first, min(s, t)), min(last, max(s, t))
        if last > first:
            dark[i // w, i % w] = True
