"""The generated streets' textures beside the truth: surface colours, and ghosts of the moving car on the road."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.texture.baselines import MAX_DISTANCE, MIN_COS
from bench.texture.scenes import Scene
from scan2sim.pipeline.camera.depth_map import load_depth_map, visible
from scan2sim.pipeline.camera.projection import pixels
from scan2sim.pipeline.camera.renderer import Body, Renderer, textured
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, U8, Bools, Mesh, PointCloud, View
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.tile import read_tile

NEAR = 15.0
"""Metres: what a photo saw from no farther is held against the truth."""
REACH = 0.1
"""Metres from a true surface sample within which the mesh stands for it."""
TRUE_REACH = 0.01
"""Metres along a ray within which a true sample is what it meets."""
SAMPLES = 300_000
TEXEL = 0.01
"""Metres between the places on the road where ghosts are looked for."""
GHOST = 40.0
"""Grey levels, meaned over 5 x 5 texels, by which a ghost differs."""
CAR = 25.0
"""Grey levels by which a pixel differs from the same photo without the car."""
VIEWS = 3
"""Photos that see a place, at least, for a ghost there to be avoidable."""
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_CODES = np.arange(256, dtype=np.float32) / 255
_LINEAR = np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** np.float32(2.4))
"""Linear light of an 8-bit sRGB value."""


@dataclass(frozen=True)
class Samples:
    """True surface samples that a used photo sees at 15 m or nearer, and that the mesh stands for.

    Seen is what nothing hides: neither the true surface (the far side of a railing, a wall's inside) nor, by the depth
    map, what the truth leaves out (parked cars).

    Attributes:
        xyz: (N, 3) local metres.
        rgb: (N, 3) uint8, the true colour.
        photo: (N, 3) float32, the colour in the nearest photo that sees it.
    """

    xyz: F32
    rgb: U8
    photo: F32


def samples(scene: Scene) -> Samples:
    """The truth of a street where it was seen from near."""
    import cv2
    import open3d as o3d

    mesh, tile = Mesh.load(scene.mesh), read_tile(scene.tile)
    assert tile.truth_points is not None and tile.truth_mesh is not None
    casting = _casting(Mesh.load(tile.truth_mesh).moved_to(mesh.frame))
    truth = las.read(tile.truth_points, mesh.frame)
    truth = truth.take(slice(None, None, max(1, len(truth) // SAMPLES)))
    places, face, distance = _closest(mesh, truth.xyz)
    on = distance < REACH
    truth, places, normals = truth.take(on), places[on], mesh.face_normal[face[on]]
    assert truth.rgb is not None
    best, colour = np.full(len(places), NEAR, np.float32), np.zeros((len(places), 3), np.float32)
    for i, view in scene.photos(held_out=False).items():
        better = np.flatnonzero(_seen(scene, i, view, places, normals, best))
        to = (truth.xyz[better] - view.centre).astype(np.float32)
        rays = np.concatenate([np.broadcast_to(view.centre.astype(np.float32), to.shape), to], axis=1)
        first = casting.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()  # in lengths of the ray to the sample
        better = better[np.abs(first - 1) * np.linalg.norm(to, axis=1) < TRUE_REACH]
        uv, _ = pixels(view.camera, view.T_world_cam, truth.xyz[better])
        photo = image.read_rgb(view.photo)
        for part in np.array_split(np.arange(len(better)), len(better) // 30_000 + 1):  # remap takes 32 767 rows
            sampled = cv2.remap(photo, uv[part][:, None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            colour[better[part]] = np.asarray(sampled).reshape(-1, 3)
        best[better] = np.linalg.norm(places[better] - view.centre, axis=1)
    near = best < NEAR
    return Samples(truth.xyz[near], truth.rgb[near], colour[near])


def _casting(mesh: Mesh) -> Any:
    import open3d as o3d

    casting = o3d.t.geometry.RaycastingScene()
    casting.add_triangles(np.ascontiguousarray(mesh.vertices), mesh.faces.astype(np.uint32))
    return casting


def _closest(mesh: Mesh, points: F32) -> tuple[F32, npt.NDArray[np.uint32], F32]:
    """Nearest places on the mesh (N, 3), their faces (N,), and metres to them (N,)."""
    answer = _casting(mesh).compute_closest_points(np.ascontiguousarray(points))
    places = answer["points"].numpy()
    return places, answer["primitive_ids"].numpy(), np.linalg.norm(places - points, axis=1)


def _seen(scene: Scene, i: int, view: View, places: F32, normals: F32, nearer_than: Any) -> Bools:
    """(N,) whether a view sees places, from the front, and nearer than so many metres."""
    to = (view.centre - places).astype(np.float32)
    distance = np.linalg.norm(to, axis=1)
    facing = np.einsum("ij,ij->i", to, normals) > MIN_COS * distance
    seen = facing & (distance < nearer_than)
    at = np.flatnonzero(seen)
    depth = load_depth_map(scene.depth / f"{i}.npy", view.camera, view.T_world_cam)
    seen[at] = visible(depth, places[at], normals[at])
    return seen


def truth_psnr(folder: Path, truth: Samples) -> tuple[float, float, float]:
    """Likeness of a texture to the true colours, as it is and after one gain a channel; share that it has of them."""
    rgb, seen, _ = Renderer([textured(folder)]).nearest(truth.xyz)
    on = seen == 255
    return *likeness(rgb[on].astype(np.float32), truth.rgb[on].astype(np.float32)), float(on.mean())


def likeness(rgb: F32, truth: F32) -> tuple[float, float]:
    """PSNR (dB) of colours (N, 3) of 0 to 255, as they are and after the least-squares gain of each channel."""
    return _psnr(rgb, truth), _psnr(np.clip(rgb * gain(rgb, truth), 0, 255), truth)


def gain(rgb: F32, truth: F32) -> F32:
    """(3,) the factors that bring colours (N, 3) nearest to the truth."""
    return np.asarray((rgb * truth).sum(axis=0) / np.maximum((rgb * rgb).sum(axis=0), 1.0), np.float32)


def _psnr(a: F32, b: F32) -> float:
    error = float(np.mean((a - b) ** 2, dtype=np.float64)) if len(a) else float("nan")
    return float(10 * np.log10(255**2 / max(error, 1e-3)))


class Road:
    """The road from above, a place every centimetre, and where the moving car may have left its ghost.

    A ghost is a place on the road (its mesh faces are those whose nearest true sample is of that class) that

    - three used photos or more see, by the depth maps of the street without the moving car,
    - at least one of those photos shows the moving car or its shadow at: it differs there from the photo of the
      same pose without the car, brought to the same exposure (which is known), by more than 25 grey levels,
    - and whose luminance in the texture of `street_hard`, meaned over 5 x 5 texels, differs from that in the
      texture which the same method makes of `street_clean` by more than 40 grey levels, one gain a channel solved
      where no photo shows the car.

    Grain, and what the method gets wrong without any car, so count for nothing; exposure that jumps, where a photo
    shows the car, counts. Only what both textures have from photos is looked at, and `painted` tells how much of
    it the method left to be filled.

    Args:
        clean, hard: the scenes, both with depth maps.
    """

    def __init__(self, clean: Scene, hard: Scene) -> None:
        mesh, tile = Mesh.load(clean.mesh), read_tile(clean.tile)
        assert tile.truth_points is not None
        self._frame = mesh.frame
        self._faces = _road_faces(mesh, las.read(tile.truth_points, mesh.frame))
        road = mesh.keep(self._faces)
        self._low, self._high = road.vertices.min(axis=0), road.vertices.max(axis=0)
        bare = self._above(Body(Mesh(road.frame, road.vertices, road.faces)))
        self._shape, self._at = bare.hit.shape, np.nonzero(bare.hit)
        # as Renderer.above places its rays
        x, y = self._low[0] + (self._at[1] + 0.5) * TEXEL, self._high[1] - (self._at[0] + 0.5) * TEXEL
        places = np.stack([x, y, self._high[2] + 1 - bare.range[self._at]], axis=1).astype(np.float32)
        normals = road.face_normal[bare.face[self._at]]
        views = np.zeros(len(places), np.uint8)
        self._car = np.zeros(len(places), bool)
        hard_photos = hard.photos(held_out=False)
        exposure = _exposures(hard)
        for i, view in clean.photos(held_out=False).items():
            seen = np.flatnonzero(_seen(clean, i, view, places, normals, MAX_DISTANCE))
            views[seen] += 1
            shows = _car_pixels(view, hard_photos[i], exposure[hard_photos[i].name])
            self._car[seen] |= _at_pixels(shows, view, places[seen])
        self._avoidable = self._car & (views >= VIEWS)

    def _above(self, body: Body) -> Any:
        width = max(1, int(np.ceil((self._high[0] - self._low[0]) / TEXEL)))
        high = self._high.copy()
        high[0] = self._low[0] + width * TEXEL
        return Renderer([body]).above(self._low, high, width=width)

    def _read(self, folder: Path) -> tuple[F32, Bools]:
        body = textured(folder)
        picture = self._above(replace(body, mesh=body.mesh.moved_to(self._frame).keep(self._faces)))
        return picture.rgb[self._at].astype(np.float32), picture.seen[self._at] == 255

    def ghosts(self, clean: Path, hard: Path, picture: Path | None = None) -> tuple[int, float]:
        """Number of ghost texels (square centimetres), and share of the avoidable places that both textures painted.

        Args:
            clean, hard: folders of one method's textures of both streets.
            picture: if given, `hard` from above is written there, at a quarter, ghosts in red.
        """
        import cv2

        (before, has_before), (after, has_after) = self._read(clean), self._read(hard)
        painted = has_before & has_after
        undisturbed = painted & ~self._car
        after = np.clip(after * gain(after[undisturbed], before[undisturbed]), 0, 255)
        difference, weight = np.zeros(self._shape, np.float32), np.zeros(self._shape, np.float32)
        difference[self._at] = (after - before) @ LUMA * painted
        weight[self._at] = painted
        mean = cv2.blur(difference, (5, 5)) / np.maximum(cv2.blur(weight, (5, 5)), 1e-6)
        ghost = painted & self._avoidable & (np.abs(mean[self._at]) > GHOST)
        if picture is not None:
            whole = np.full((*self._shape, 3), 255, np.uint8)
            whole[self._at] = after
            whole[tuple(a[ghost] for a in self._at)] = (255, 0, 0)
            image.write(picture, np.asarray(cv2.resize(whole, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)))
        return int(ghost.sum()), float(painted[self._avoidable].mean()) if self._avoidable.any() else float("nan")

    @property
    def avoidable(self) -> int:
        """Places where a photo shows the car or its shadow, and three or more see the road."""
        return int(self._avoidable.sum())


def _road_faces(mesh: Mesh, truth: PointCloud) -> Bools:
    """(F,) whether a face's nearest true sample is of the road, and near."""
    from scipy.spatial import cKDTree

    assert truth.classification is not None
    distance, index = cKDTree(truth.xyz).query(mesh.corners.mean(axis=1), workers=-1)
    return (truth.classification[index] == CODE["road"]) & (distance < 2 * REACH)


def _exposures(scene: Scene) -> dict[str, float]:
    """Name of a view to its exposure, EV."""
    lines = (scene.tile / "truth" / "exposures.csv").read_text(encoding="utf-8").splitlines()[1:]
    return {Path(file).with_suffix("").as_posix(): float(ev) for file, ev in (line.split(",") for line in lines)}


def _car_pixels(clean: View, hard: View, ev: float) -> Bools:
    """(H, W) where the photo of `hard` shows what that of `clean`, brought to its exposure, does not."""
    import cv2

    from scan2sim.data_samples.scene import srgb

    without, photo = image.read_rgb(clean.photo), image.read_rgb(hard.photo)
    expected = srgb(_LINEAR[without] * np.float32(2.0**ev))
    difference = cv2.blur((photo.astype(np.float32) - expected) @ LUMA, (5, 5))
    return np.abs(difference) > CAR


def _at_pixels(mask: Bools, view: View, places: F32) -> Bools:
    """(N,) the mask's values where a view sees places."""
    uv, _ = pixels(view.camera, view.T_world_cam, places)
    column, row = np.rint(np.clip(uv, 0, [view.camera.width - 1, view.camera.height - 1])).astype(int).T
    return mask[row, column]
