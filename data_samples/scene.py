"""Street as a triangle mesh under sun and sky: ray casting and shading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.data_samples import objects, paints, signs
from scan2sim.data_samples.layout import FRAME, HALF_WIDTH, Layout
from scan2sim.data_samples.paints import Material, Paint, linear
from scan2sim.data_samples.road_users import RoadUser
from scan2sim.data_samples.shapes import Part, join, sheet
from scan2sim.pipeline.core.types import F32, F64, I32, U8, Bools, Mesh

CAR_SPEED_M_S = 8.0  # of the moving car
SUN_COLOUR = np.array([1.06, 1.0, 0.88], np.float32)
SKY_COLOUR = np.array([0.90, 1.0, 1.16], np.float32)
GROUND_SPACING_M = 0.33  # between vertices of the ground
OPENNESS_OFFSET_M = 0.2  # offset from a surface at which its sky openness is traced, to clear sills and surrounds
TRUTH_FOOTPRINT_M = np.float32(0.01)  # width over which textures of the ground truth are filtered


def build(layout: Layout) -> tuple[Part, Part, Part]:
    """Meshes of the static world and of the parked cars (local coordinates), and of the moving car (its own)."""
    static = [*_ground(layout)]
    for h in layout.houses:
        xy, heading = layout.axis.place(h.s + h.width / 2, h.side * h.front)
        static.append(_facing_road(layout, objects.house(h), -h.width / 2, h.side, xy, heading))
    for t in layout.trees:
        xy, heading = layout.axis.place(t.s, t.t)
        mesh = objects.bush(t) if t.bush else objects.tree(t)
        static.append(mesh.moved(float(heading), (*xy, float(layout.height(t.s, t.t)))))
    for b in layout.boundaries:
        pieces = max(1, round((b.s1 - b.s0) / 6))  # short straight pieces follow the curve of the road
        for s0 in np.linspace(b.s0, b.s1, pieces + 1)[:-1]:
            length = (b.s1 - b.s0) / pieces
            xy, heading = layout.axis.place(s0 + length / 2, b.t)
            piece = objects.boundary(replace(b, seed=b.seed + int(s0 * 10)), length)
            static.append(_facing_road(layout, piece, -length / 2, 1 if b.t > 0 else -1, xy, heading))
    for p in layout.posts:
        xy, heading = layout.axis.place(p.s, p.t)
        if p.sign is None:  # the lamp's arm extends over the road
            mesh, turn = objects.lamp(), float(heading) + (np.pi if p.t > 0 else 0.0)
        else:  # a sign faces approaching traffic
            mesh, turn = objects.sign(p.sign), float(heading) + (-np.pi / 2 if p.towards == 1 else np.pi / 2)
        static.append(mesh.moved(turn, (*xy, float(layout.height(p.s, p.t)))))
    parked = []
    for c in layout.parked:
        xy, heading = layout.axis.place(c.s, c.t)
        turn = float(heading) + (0.0 if c.towards == 1 else np.pi)
        parked.append(objects.car(c.colour).moved(turn, (*xy, float(layout.height(c.s, c.t)) + 0.01)))
    for extra in layout.extras:
        xy, heading = layout.axis.place(extra.s, extra.t)
        mesh = extra.make().moved(float(heading) + extra.turn, (*xy, float(layout.height(extra.s, extra.t))))
        (parked if extra.movable else static).append(mesh)
    moving = objects.car(layout.moving)
    empty = _face_subset(moving, np.zeros(len(moving.faces), bool))
    fixed = join(static)
    # multiples of half a millimetre are exact in float32, and compress well
    grid = np.round(fixed.vertices * 2048) / np.float32(2048)
    return replace(fixed, vertices=grid.astype(np.float32)), join(parked) if parked else empty, moving


def _facing_road(layout: Layout, mesh: Part, x: float, side: int, xy: F64, heading: F64) -> Part:
    """Place a mesh whose front faces -y at `xy` beside the road, its front towards the road."""
    turn = float(heading) + (0.0 if side == 1 else np.pi)
    s, t = layout.axis.locate(xy)
    return mesh.moved(0.0, (x, 0, 0)).moved(turn, (*xy, float(layout.height(s, t))))


def _face_subset(mesh: Part, keep: Bools) -> Part:
    per_face = {
        name: getattr(mesh, name)[keep] for name in ("faces", "material", "classification", "colour", "seed", "size")
    }
    return replace(mesh, **per_face)


def _ground(layout: Layout) -> list[Part]:
    """Carriageway, bays, kerbs, pavements and terrain, as strips along the axis; no terrain inside houses."""
    rows, kerb_height = max(2, round(layout.axis.length / GROUND_SPACING_M) + 1), layout.kerb_height
    s = np.linspace(0, layout.axis.length, rows)
    grass = Paint(Material.GRASS, linear("#5d7434"), paints.TERRAIN, layout.seed % 1000)
    slabs = Paint(Material.SLABS, linear("#b5b0a6"), paints.SIDEWALK, layout.seed % 1000)
    stone = Paint(Material.KERB, linear("#a8a6a0"), paints.SIDEWALK, 3)
    setts = layout.bays or Paint(Material.SETTS, linear("#7d7873"), paints.ROAD, 5)
    asphalt = Paint(Material.ASPHALT, layout.asphalt, paints.ROAD, 100 + layout.seed % 1000)

    def strip(t0: float, t1: float, paint: Paint, *, below: bool = False) -> Part:
        count = max(2, round((t1 - t0) / GROUND_SPACING_M) + 1)
        return surface(np.linspace(t0, t1, count), paint, below)

    def surface(t: F64, paint: Paint, below: bool) -> Part:
        tt, ss = np.meshgrid(t, s, indexing="ij")
        xy, _ = layout.axis.place(ss, tt)
        xyz = np.concatenate([xy, layout.height(ss, tt, below_kerb=below)[..., None]], axis=-1)
        return sheet(xyz, np.stack([ss, tt], axis=-1), paint)

    parts = [strip(-layout.lane, layout.lane, asphalt, below=True)]
    for side in (1, -1):
        k, g = layout.kerb(side), layout.garden(side)
        walks = [(w.near, w.far, w.paint, False) for w in layout.walks if w.side == side]
        for near, far, paint, below in (
            (layout.lane, k, setts, True),
            (k, k + 0.15, stone, False),
            *(walks or [(k + 0.15, g, slabs, False), (g, HALF_WIDTH, grass, False)]),
        ):
            if far > near:
                parts.append(strip(min(side * near, side * far), max(side * near, side * far), paint, below=below))
        xy, _ = layout.axis.place(s, side * k)
        foot = np.column_stack([xy, layout.height(s, side * k, below_kerb=True)])
        top = np.column_stack([xy, layout.height(s, side * k)])
        face = np.stack([foot, top] if side == 1 else [top, foot])
        v_range = (0, kerb_height) if side == 1 else (kerb_height, 0)
        uv = np.stack([np.column_stack([s, v + 0 * s]) for v in v_range])
        parts.append(sheet(face[::-1], uv[::-1], stone))
    return [_face_subset(p, ~_inside_houses(layout, p)) if p.classification[0] == paints.TERRAIN else p for p in parts]


def _inside_houses(layout: Layout, mesh: Part) -> Bools:
    """(F,) whether a face lies inside a house, with a margin of 0.4 m."""
    middle = mesh.vertices[mesh.faces].mean(axis=1)[:, :2]
    inside = np.zeros(len(middle), bool)
    for h in layout.houses:
        xy, heading = layout.axis.place(h.s + h.width / 2, h.side * h.front)
        turn = float(heading) + (0.0 if h.side == 1 else np.pi)
        d = middle - xy
        x, y = d @ [np.cos(turn), np.sin(turn)], d @ [-np.sin(turn), np.cos(turn)]
        inside |= (abs(x) < h.width / 2 - 0.4) & (y > 0.4) & (y < h.depth - 0.4)
    return inside


@dataclass(frozen=True)
class Hits:
    """First hits of rays.

    Attributes:
        distance: (N,) float32 metres, infinite if nothing was hit.
        face: (N,) int32 index into `Scene.surface`, -1 if nothing was hit.
        bary: (N, 2) float32 barycentric weights of the face's second and third corner.
        heading: (N,) float32 heading of the road user that was hit, radians; 0 for static surfaces.
    """

    distance: F32
    face: I32
    bary: F32
    heading: F32

    @property
    def hit(self) -> Bools:
        """(N,) whether a surface was hit."""
        return self.face >= 0


class Scene:
    """A street for ray casting, in local float32 coordinates of `layout.FRAME`.

    Attributes:
        layout: the street.
        road_users: those that move, besides the oncoming car.
        surface: static street, then parked cars, then the moving car and road users in their own coordinates.
        static: number of faces of the static street.
    """

    def __init__(self, layout: Layout, road_users: Sequence[RoadUser] = ()) -> None:
        self.layout = layout
        self.road_users = tuple(road_users)
        static, parked, car = build(layout)
        self.static = len(static.faces)
        both = join([static, parked])
        movers = [car, *(user.mesh for user in road_users)]
        self._first_face = np.cumsum([self.static + len(parked.faces), *(len(mesh.faces) for mesh in movers)])
        self._street = caster(both)
        self._movers = [caster(mesh) for mesh in movers]
        self._sign_images = signs.images()
        lit = [replace(m, sky=np.clip(0.55 + 0.4 * m.normals[:, 2], 0, 1).astype(np.float32)) for m in movers]
        self.surface = join([replace(both, sky=self._openness(both)), *lit])

    def truth_mesh(self) -> Mesh:
        """Labelled mesh of the static street, without vehicles."""
        part = self.surface
        mesh = Mesh(FRAME, part.vertices, part.faces, classification=part.classification)
        return mesh.keep(np.arange(len(part.faces)) < self.static)

    def car_at(self, time: npt.ArrayLike, way: Any) -> tuple[F64, F64, Bools]:
        """Pose of the moving car `time` seconds after it passes the middle of the street.

        Args:
            time: (...) seconds.
            way: direction of travel along the axis, 1 or -1.

        Returns:
            Position (..., 3), heading (...), and whether it is within the street (never if the style has none).
        """
        s = self.layout.axis.length / 2 + np.asarray(time, np.float64) * CAR_SPEED_M_S * way
        t = -np.asarray(way) * self.layout.lane / 2
        xy, heading = self.layout.axis.place(s, t)
        z = self.layout.height(s, t) + 0.01
        margin = objects.CAR_LENGTH_M / 2 + 0.1
        inside = self.layout.moving_car & (s > margin) & (s < self.layout.axis.length - margin)
        return np.concatenate([xy, z[..., None]], axis=-1), heading + np.where(np.asarray(way) > 0, 0.0, np.pi), inside

    def cast(self, origins: F32, directions: F32, car: CarPoses | None = None) -> Hits:
        """First hits of rays with origins (N, 3) and unit directions (N, 3); `car`: poses of all that moves per ray."""
        rays = np.concatenate([origins, directions], axis=1)
        answer = cast_rays(self._street, rays)
        heading = np.zeros(len(rays), np.float32)
        for k, mover in enumerate(self._movers if car is not None else []):
            assert car is not None
            pose = car.of(k)
            index, own = self._to_mover(rays, pose)
            if len(index):
                near = cast_rays(mover, own)
                closer = near.distance < answer.distance[index]
                at = index[closer]
                answer.distance[at] = near.distance[closer]
                answer.face[at] = near.face[closer] + self._first_face[k]
                answer.bary[at] = near.bary[closer]
                heading[at] = pose.heading[at]
        return replace(answer, heading=heading)

    def _to_mover(self, rays: F32, car: CarPoses) -> tuple[npt.NDArray[np.intp], F32]:
        """Rays that may hit what moves at one pose per ray: their indices, and the rays (M, 6) in its coordinates."""
        if not car.present.any():
            return np.zeros(0, np.intp), np.zeros((0, 6), np.float32)
        middle = car.position + np.array([0, 0, 0.7], np.float32)
        to = middle - rays[:, :3]
        along = np.einsum("ij,ij->i", to, rays[:, 3:])
        aside = np.einsum("ij,ij->i", to, to) - along**2
        index = np.flatnonzero(car.present & (aside < 2.5**2) & (along > -2.5))
        c, s = np.cos(car.heading[index]), np.sin(car.heading[index])
        o, d = rays[index, :3] - car.position[index], rays[index, 3:]
        own = [
            c * o[:, 0] + s * o[:, 1],
            c * o[:, 1] - s * o[:, 0],
            o[:, 2],
            c * d[:, 0] + s * d[:, 1],
            c * d[:, 1] - s * d[:, 0],
            d[:, 2],
        ]
        return index, np.stack(own, axis=1).astype(np.float32)

    def colour(
        self, origins: F32, directions: F32, hits: Hits, footprint: npt.ArrayLike, car: CarPoses | None = None
    ) -> F32:
        """(N, 3) linear light along rays from their hits; zero without a hit.

        Args:
            origins, directions: (N, 3) rays.
            hits: their hits.
            footprint: (N,) or scalar width of the pixel at the hit, metres.
            car: poses of all that moves, for its shadows; None: without them.
        """
        light = np.zeros((len(directions), 3), np.float32)
        at = np.flatnonzero(hits.hit)
        xyz = origins[at] + directions[at] * hits.distance[at, None]
        size = np.broadcast_to(np.asarray(footprint, np.float32), len(directions))[at]
        light[at] = self.lit(xyz, hits.face[at], hits.bary[at], hits.heading[at], size, car.take(at) if car else None)
        return light

    def lit(self, xyz: F32, face: Any, bary: F32, heading: F32, footprint: F32, car: CarPoses | None = None) -> F32:
        """(N, 3) linear light reflected by surface points `xyz`, the same in all directions (Lambertian)."""
        from scan2sim.data_samples import materials

        p = self.surface
        albedo, normal, sky = materials.surface(
            face, bary, footprint, p.faces, p.normals, p.uv, p.sky, p.material, p.colour, p.seed, p.size,
            self.layout.road, self._sign_images,
        )  # fmt: skip
        turned = np.flatnonzero(heading)
        if len(turned):
            c, s = np.cos(heading[turned]), np.sin(heading[turned])
            x, y = normal[turned, 0].copy(), normal[turned, 1].copy()
            normal[turned, 0], normal[turned, 1] = c * x - s * y, s * x + c * y
        sun = self.layout.sun.astype(np.float32)
        facing = normal @ sun
        leaf = p.material[face] == Material.FOLIAGE
        facing = np.where(leaf, np.clip(0.30 + 0.70 * facing, 0.12, 1), np.clip(facing, 0, 1)).astype(np.float32)
        lit = np.flatnonzero(facing > 0)
        rays = np.empty((len(lit), 6), np.float32)
        rays[:, :3] = xyz[lit] + 0.012 * np.where(leaf[lit, None], 0, normal[lit]) + 0.012 * sun
        rays[:, 3:] = sun
        shaded = occluded(self._street, rays)
        if car is not None:
            for k, mover in enumerate(self._movers):
                index, own = self._to_mover(rays, car.of(k).take(lit))
                shaded[index] |= occluded(mover, own)
        facing[lit[shaded]] = 0
        return reflected_light(albedo, normal, sky, facing, self.layout.sun_strength, self.layout.sky_strength)

    def _openness(self, part: Part) -> F32:
        """(V,) sky openness: cosine-weighted share of the hemisphere above each vertex that is free for 5 m."""
        rng = np.random.default_rng([self.layout.seed, 2])
        sky = part.sky.copy()
        todo = np.flatnonzero(np.isnan(sky))
        directions = rng.normal(size=(40, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        for block in np.array_split(todo, max(1, len(todo) // 40_000)):
            normal = part.normals[block]
            d = normal[:, None] * 1.02 + directions[None]
            d /= np.linalg.norm(d, axis=2, keepdims=True)
            o = np.broadcast_to((part.vertices[block] + OPENNESS_OFFSET_M * normal)[:, None], d.shape)
            rays = np.concatenate([o, d], axis=2).reshape(-1, 6).astype(np.float32)
            sky[block] = 1 - occluded(self._street, rays, 5.0).reshape(-1, len(directions)).mean(axis=1)
        return np.clip(0.12 + 0.88 * sky, 0, 1).astype(np.float32)


@dataclass(frozen=True)
class CarPoses:
    """Poses of K moving road users, the oncoming car first, for each of N rays.

    Attributes:
        position: (N, K, 3) float32.
        heading: (N, K) float32, radians.
        present: (N, K) whether it is in the street.
    """

    position: F32
    heading: F32
    present: Bools

    def repeated(self, times: int) -> CarPoses:
        """Each pose repeated `times` times."""
        index = np.repeat(np.arange(len(self.heading)), times)
        return self.take(index)

    def of(self, k: int) -> CarPoses:
        """Poses (N, ...) of one road user."""
        return CarPoses(self.position[:, k], self.heading[:, k], self.present[:, k])

    def take(self, index: npt.NDArray[Any]) -> CarPoses:
        """Poses of selected rays."""
        return CarPoses(self.position[index], self.heading[index], self.present[index])


def caster(part: Part | Mesh) -> Any:
    """Open3D ray casting scene of a mesh."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(part.vertices), tensor(part.faces.astype(np.uint32)))
    return scene


def tensor(array: npt.NDArray[Any]) -> Any:
    """Open3D tensor of an array."""
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))


def cast_rays(caster: Any, rays: F32) -> Hits:
    """First hits of rays (N, 6), origins and unit directions."""
    answer = caster.cast_rays(tensor(rays))
    distance = answer["t_hit"].numpy().copy()
    face = np.where(np.isfinite(distance), answer["primitive_ids"].numpy().astype(np.int64), -1).astype(np.int32)
    return Hits(distance, face, answer["primitive_uvs"].numpy().copy(), np.zeros(len(rays), np.float32))


def occluded(caster: Any, rays: F32, far: float = float("inf")) -> Bools:
    """(N,) whether rays (N, 6) hit anything within `far` metres."""
    if len(rays) == 0:
        return np.zeros(0, bool)
    return caster.test_occlusions(tensor(rays), 0.0, far).numpy().copy()


def reflected_light(albedo: F32, normal: F32, sky: F32, facing: F32, sun_strength: float, sky_strength: float) -> F32:
    """(N, 3) linear light reflected by Lambertian surfaces under sun and sky.

    Args:
        albedo, normal: (N, 3).
        sky: (N,) sky openness.
        facing: (N,) cosine of the angle between normal and sun, 0 in shadow.
        sun_strength, sky_strength: irradiance of sun and sky.
    """
    up = normal[:, 2]
    direct = facing[:, None] * (SUN_COLOUR * np.float32(sun_strength))
    ambient = (sky * (0.68 + 0.32 * up))[:, None] * (SKY_COLOUR * np.float32(sky_strength))
    bounce = (sky * (0.5 - 0.5 * up))[:, None] * (SUN_COLOUR * np.float32(0.14))
    return (albedo * (direct + ambient + bounce)).astype(np.float32)


def srgb(light: npt.ArrayLike) -> U8:
    """8-bit sRGB of linear light, clipped."""
    x = np.clip(np.asarray(light, np.float32), 0, 1)
    return (255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** np.float32(1 / 2.4) - 0.055) + 0.5).astype(np.uint8)
