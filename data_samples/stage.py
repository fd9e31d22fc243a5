"""Fast renderer for a static camera: the static scene is rendered once, moving objects are cast into each frame.

Shading is a simplification of `scene`: sky openness is guessed, and vehicles cast shadows on the ground but not on each
other. Paint and glass of vehicles reflect the sky slightly.
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
from scan2sim.data_samples.scene import Hits, cast_rays, caster, occluded, reflected_light, srgb
from scan2sim.data_samples.shapes import Part
from scan2sim.data_samples.town import with_sky_openness
from scan2sim.pipeline.core.types import F32, F64, I32, U8, Bools, Camera

LENS_BLUR_PX = 0.55
"""Standard deviation of the lens's blur."""
NO_ROAD = np.array([3.2, -1e6, 0.0])
DEPTH_MIN_M = 0.3
REFLECTANCE = {Material.CAR_BODY: 0.04, Material.CAR_END: 0.04, Material.CAR_GLASS: 0.10, Material.WINDOW: 0.08}
"""Specular reflectance of materials of vehicles at normal incidence."""


@dataclass(frozen=True)
class Light:
    """Light of a time of day.

    Attributes:
        sun: (3,) unit vector towards the sun.
        sun_strength, sky_strength: as in `layout.Style`.
        cloudiness: share of clouds in the sky.
        exposure: target mean of the static image, in 0 to 1 (sRGB), of the camera's exposure control.
    """

    sun: F64
    sun_strength: float
    sky_strength: float
    cloudiness: float
    exposure: float = 0.45


class Body:
    """Mesh of an object for ray casting, in its own coordinates, x forwards."""

    def __init__(self, part: Part) -> None:
        self.part = with_sky_openness(part)
        self.low, self.high = part.vertices.min(axis=0), part.vertices.max(axis=0)
        self.mirror = np.zeros(256, np.float32)
        for material, share in REFLECTANCE.items():
            self.mirror[material] = share

    @cached_property
    def caster(self) -> Any:
        """Ray casting scene of the mesh."""
        return caster(self.part)


@dataclass(frozen=True)
class Piece:
    """A body at a position (3,), rotated by `heading` about z, radians."""

    body: Body
    position: F64
    heading: float


@dataclass(frozen=True)
class Actor:
    """A labelled object: a car of one piece, or a train of several.

    Attributes:
        label: its class, one of `fleet.CLASSES`.
        track: track id, the same in all frames.
        pieces: its bodies.
        speed: m/s.
    """

    label: str
    track: int
    pieces: tuple[Piece, ...]
    speed: float = 0.0


@dataclass(frozen=True)
class VisibleActor:
    """Ground truth of an actor in a frame.

    Attributes:
        actor: the actor.
        box: x0, y0, x1, y1 in pixels, clipped to the frame, including occluded parts; edges of pixels, so that the
            whole frame is 0, 0, W, H.
        visible: share of its pixels within the frame that aren't occluded.
        pixels: number of visible pixels.
    """

    actor: Actor
    box: tuple[int, int, int, int]
    visible: float
    pixels: int


@dataclass(frozen=True)
class Frame:
    """A rendered frame: image (H, W, 3), its actors, and the index of the actor at each pixel (H, W), -1: none."""

    rgb: U8
    visible: list[VisibleActor]
    owner: I32


@dataclass(frozen=True)
class Backdrop:
    """Static image of a camera, with a border around the frames for camera shake.

    Attributes:
        camera, T_world_cam: intrinsics and pose.
        sunny, shady: (H, W, 3) in sunlight, and in the shadow of an actor.
        distance: (H, W) metres along the ray, infinite for the sky.
        gain: exposure, factor on the light.
    """

    camera: Camera
    T_world_cam: F64
    sunny: U8
    shady: U8
    distance: F32
    gain: float


class Stage:
    """Static scene and its light.

    Args:
        part: static mesh.
        light: light.
        seed: seed of the sky and the background.
    """

    def __init__(self, part: Part, light: Light, seed: int = 0) -> None:
        self.part, self.light, self.seed = with_sky_openness(part), light, seed
        self._caster = caster(part)
        self._sign_images = signs.images()

    def distances(self, camera: Camera, T_world_cam: F64, step: int = 16) -> F32:
        """(h, w) distance to the static scene at every `step`-th pixel, metres."""
        return self._cast(*self._rays(camera, T_world_cam, step))[0].distance.reshape(camera.height // step, -1)

    def backdrop(self, camera: Camera, T_world_cam: F64, samples: int = 2) -> Backdrop:
        """Render the static scene, with `samples` squared rays per pixel."""
        offsets = (np.arange(samples) + 0.5) / samples - 0.5
        sunny, shady = np.zeros((2, camera.height * camera.width, 3), np.float32)
        for right in offsets:
            for down in offsets:
                origins, rays = self._rays(camera, T_world_cam, 1, (right, down))
                hits, light, shade = self._cast(origins, rays, 1 / camera.fx)
                sunny += light
                shady += shade
        shape = (camera.height, camera.width)
        gain = _exposure_gain(sunny / np.float32(samples**2), self.light.exposure)
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
        """Hits of rays with origins and directions (N, 3), and their linear light (N, 3) with and without sun."""
        hits = cast_rays(self._caster, np.concatenate([origins, rays], axis=1))
        at, light = np.flatnonzero(hits.hit), self.light
        sun = light.sun.astype(np.float32)
        size = (angle * hits.distance[at]).astype(np.float32)
        albedo, normal, open_ = self._surface(self.part, hits.face[at], hits.bary[at], size)
        facing = np.maximum(normal @ sun, 0)
        leaf = self.part.material[hits.face[at]] == Material.FOLIAGE
        facing = np.where(leaf, 0.3 + 0.7 * facing, facing).astype(np.float32)
        start = origins[at] + rays[at] * hits.distance[at, None] + 0.02 * normal + 0.012 * sun
        toward = np.concatenate([start, np.broadcast_to(sun, start.shape)], axis=1).astype(np.float32)
        facing[occluded(self._caster, toward)] = 0
        both = np.zeros((2, len(rays), 3), np.float32)
        for which, direct in enumerate((facing, np.zeros_like(facing))):
            both[which, at] = reflected_light(albedo, normal, open_, direct, light.sun_strength, light.sky_strength)
        out = np.flatnonzero(~hits.hit)
        axis, ends = np.array([0.0, 1e-4, 0.0]), np.zeros(2)
        beyond = sky.beyond(origins[out], rays[out], light.sun, light.cloudiness, axis, ends, self.seed)
        both[:, out] = beyond * (light.sky_strength / 0.42)
        return hits, both[0], both[1]

    def _surface(self, part: Part, face: Any, bary: F32, size: F32) -> tuple[F32, F32, F32]:
        return materials.surface(
            face, bary, size, part.faces, part.normals, part.uv, part.sky, part.material, part.colour, part.seed,
            part.size, NO_ROAD, self._sign_images,
        )  # fmt: skip

    def frame(self, backdrop: Backdrop, actors: list[Actor], size: tuple[int, int], shake: F64 | None = None) -> Frame:
        """Render a frame with actors.

        Args:
            backdrop: static image.
            actors: moving objects.
            size: width and height of the frame, pixels.
            shake: (2, 3) affine transform from the frame's pixels to the backdrop's; None: centred.
        """
        import cv2

        view = View(backdrop, size, centred_shake(backdrop, size) if shake is None else shake)
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
        order = [
            (float(np.linalg.norm(p.position - view.origin)), i, p) for i, a in enumerate(actors) for p in a.pieces
        ]
        for _, i, piece in sorted(order, key=lambda x: x[:2]):  # nearest first: occluded pixels need no shading
            self._add(view, piece, i, rgb, distance, owner, hidden[i])
        truths = [_visible(actor, hidden[i], owner == i) for i, actor in enumerate(actors)]
        return Frame(cv2.GaussianBlur(rgb, (5, 5), LENS_BLUR_PX), [s for s in truths if s is not None], owner)

    def _add(self, view: View, piece: Piece, index: int, rgb: U8, distance: F32, owner: I32, whole: Bools) -> None:
        """Cast a piece, and draw it where it is the nearest surface; `whole`: its pixels, including occluded ones."""
        body = piece.body
        rect = view.around(corners(piece))
        if rect is None:
            return
        rays = view.rays(rect)
        turn = rotation_z(piece.heading)
        own = np.empty((len(rays), 6), np.float32)
        own[:, :3] = (view.origin - piece.position) @ turn
        own[:, 3:] = rays @ turn.astype(np.float32)
        hits = cast_rays(body.caster, own)
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
        """(N, 3) sRGB colours of a body's surface at the hits `at` (N,)."""
        light, sun = self.light, self.light.sun.astype(np.float32)
        size = (view.angle * hits.distance[at]).astype(np.float32)
        albedo, normal, open_ = self._surface(body.part, hits.face[at], hits.bary[at], size)
        normal = normal @ turn.T.astype(np.float32)
        facing = np.maximum(normal @ sun, 0)
        out = reflected_light(albedo, normal, open_, facing, light.sun_strength, light.sky_strength)
        share = body.mirror[body.part.material[hits.face[at]]][:, None]
        cosine = np.abs(np.einsum("ij,ij->i", rays, normal))[:, None]
        share = np.where(share > 0, share + (1 - share) * (1 - cosine) ** 5, 0)
        up = (rays - 2 * np.einsum("ij,ij->i", rays, normal)[:, None] * normal)[:, 2:]
        reflected = light.sky_strength * np.where(up > 0, 1.9 - 0.9 * np.clip(up, 0, 1), 0.25)
        glint = np.maximum((rays - 2 * (rays * normal).sum(axis=1)[:, None] * normal) @ sun, 0)[:, None] ** 60
        out = out + share * (reflected + 4 * light.sun_strength * glint)
        return srgb(out * view.gain)

    def _shade(self, view: View, actors: list[Actor], distance: F32) -> tuple[Bools, F32]:
        """(H, W) whether a pixel is in the shadow of an actor, and (H, W) contact shadow: factor on the light."""
        dark, dim = np.zeros(distance.shape, bool), np.ones(distance.shape, np.float32)
        sun = self.light.sun
        for piece in (p for a in actors for p in a.pieces):
            box = corners(piece)
            ground = box.copy()
            ground[:, 2] = piece.position[2]
            contact = piece.position + (ground - piece.position) * 1.4
            rect = view.around(np.concatenate([box, _shadow_corners(box, sun, float(piece.position[2])), contact]))
            if rect is None:
                continue
            low, high = piece.body.low.astype(np.float64), piece.body.high.astype(np.float64)
            own = rotation_z(piece.heading)
            _cast_shadow(
                view.rays(rect), distance[rect].ravel(), (view.origin - piece.position) @ own, own, sun @ own, low,
                high, dark[rect], dim[rect],
            )  # fmt: skip
        return dark, dim


class View:
    """Geometry of a frame within a backdrop."""

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
        """(N, 3) unit directions of the rays through the pixels of a rectangle."""
        return np.ascontiguousarray(self._rays[rect]).reshape(-1, 3)

    def project(self, points: F64) -> tuple[F64, F64]:
        """Pixels (N, 2) of the frame, and depth (N,), of points (N, 3)."""
        own = (points - self.origin) @ self._pose[:3, :3]
        depth = own[:, 2]
        flat = own[:, :2] / np.maximum(depth, 1e-6)[:, None]
        wide = flat * [self._camera.fx, self._camera.fy] + [self._camera.cx, self._camera.cy]
        return wide @ self._back[:2, :2].T + self._back[:2, 2], depth

    def around(self, points: F64) -> tuple[slice, slice] | None:
        """Rows and columns of the frame that the convex hull of points (N, 3) may cover; None: none."""
        pixels, depth = self.project(points)
        ahead = depth > DEPTH_MIN_M
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
    """(H, W, 3) homogeneous coordinates of each pixel: x, y, 1."""
    v, u = np.mgrid[: size[1], : size[0]].astype(np.float32)
    return np.stack([u, v, np.ones_like(u)], axis=-1)


def centred_shake(
    backdrop: Backdrop, size: tuple[int, int], turn: float = 0.0, aside: npt.ArrayLike = (0.0, 0.0)
) -> F64:
    """(2, 3) affine transform from a frame's pixels to the backdrop's.

    Args:
        backdrop: static image.
        size: width and height of the frame.
        turn: rotation about the common centre, radians.
        aside: translation, pixels.
    """
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    frame_centre = (np.array(size) - 1) / 2
    centre = (np.array([backdrop.camera.width, backdrop.camera.height]) - 1) / 2 + np.asarray(aside)
    return np.column_stack([rotation, centre - rotation @ frame_centre])


def with_margin(camera: Camera, margin: int) -> Camera:
    """Camera whose image has `margin` more pixels on each side."""
    return replace(
        camera, width=camera.width + 2 * margin, height=camera.height + 2 * margin,
        cx=camera.cx + margin, cy=camera.cy + margin,
    )  # fmt: skip


def _exposure_gain(light: F32, aim: float) -> float:
    """Gain for which the image of linear light (N, 3) has the mean `aim`, in 0 to 1 (sRGB)."""
    sample, low, high = light[:: max(1, len(light) // 20_000)], 0.05, 20.0
    for _ in range(20):
        gain = float(np.sqrt(low * high))
        low, high = (gain, high) if srgb(sample * gain).mean() < 255 * aim else (low, gain)
    return gain


def corners(piece: Piece) -> F64:
    """(8, 3) corners of a piece's bounding box."""
    low, high = piece.body.low, piece.body.high
    own = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    return own @ rotation_z(piece.heading).T + piece.position


def rotation_z(heading: float) -> F64:
    """(3, 3) rotation from a body's axes to the world's."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _shadow_corners(box: F64, sun: F64, ground: float) -> F64:
    """(8, 3) projection of a box's corners along the sunlight to the ground, at most 40 metres away."""
    distance = np.minimum((box[:, 2] - ground) / max(sun[2], 0.02), 40.0)
    return box - distance[:, None] * sun


def _visible(actor: Actor, whole: Bools, own: Bools) -> VisibleActor | None:
    """Ground truth of an actor from masks of all, and of its visible pixels; None: it is outside of the frame."""
    rows, columns = np.flatnonzero(whole.any(axis=1)), np.flatnonzero(whole.any(axis=0))
    if not len(rows):
        return None
    box = (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    pixels = int(own.sum())
    return VisibleActor(actor, box, round(pixels / int(whole.sum()), 4), pixels)


@njit(cache=True)
def _cast_shadow(
    rays: npt.NDArray[Any], distance: npt.NDArray[Any], origin: npt.NDArray[Any], turn: npt.NDArray[Any],
    sun: npt.NDArray[Any], low: npt.NDArray[Any], high: npt.NDArray[Any], dark: npt.NDArray[Any],
    dim: npt.NDArray[Any],
) -> None:  # fmt: skip
    """Mark pixels in the shadow of a box, and darken those below and beside it (contact shadow).

    Args:
        rays, distance: (N, 3), (N,) of pixels, in world axes.
        origin, sun: (3,) camera, and direction of the sun, in the box's axes.
        turn: (3, 3) rotation from the box's axes to the world's.
        low, high: (3,) corners of the box, in its axes.
        dark, dim: (h, w), updated in place.
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
