"""Textures of the generated streets compared with the truth: surface colours, and ghosts of the moving car."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.texture.baselines import MAX_DISTANCE_M, MIN_INCIDENCE_COS
from bench.texture.scenes import Scene
from scan2sim.pipeline.camera.depth_map import load_depth_map, visible
from scan2sim.pipeline.camera.projection import pixels
from scan2sim.pipeline.camera.renderer import Body, Renderer, textured
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F32, U8, Bools, Mesh, PointCloud, View
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.tile import read_tile

MAX_TRUTH_RANGE_M = 15.0
"""Maximum range of a photo whose content is compared with the truth."""
MESH_DISTANCE_M = 0.1
"""Maximum distance from a true surface sample to the mesh that represents it."""
RAY_TOLERANCE_M = 0.01
"""Tolerance along a ray within which a true sample is its first hit."""
SAMPLES = 300_000
TEXEL_M = 0.01
"""Distance between road samples for ghosts."""
GHOST_LEVELS = 40.0
"""Minimum difference of a ghost in grey levels, averaged over 5 x 5 texels."""
CAR_LEVELS = 25.0
"""Minimum difference in grey levels of a pixel from the same photo without the car."""
MIN_VIEWS = 3
"""Minimum number of photos that see a sample for a ghost there to be avoidable."""
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_CODES = np.arange(256, dtype=np.float32) / 255
_LINEAR = np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** np.float32(2.4))
"""Linear light of an 8-bit sRGB value."""


@dataclass(frozen=True)
class Samples:
    """True surface samples that a used photo sees within 15 m, and that the mesh represents.

    A sample is seen if neither the true surface (such as the far side of a railing or the inside of a wall) nor the
    depth map (parked cars, which the truth omits) occludes it.

    Attributes:
        xyz: (N, 3) local metres.
        rgb: (N, 3) uint8, the true colour.
        photo: (N, 3) float32, the colour in the nearest photo that sees it.
    """

    xyz: F32
    rgb: U8
    photo: F32


def samples(scene: Scene) -> Samples:
    """True samples of a street that were seen from near."""
    import cv2
    import open3d as o3d

    mesh, tile = Mesh.load(scene.mesh), read_tile(scene.tile)
    assert tile.truth_points is not None and tile.truth_mesh is not None
    casting = _casting(Mesh.load(tile.truth_mesh).moved_to(mesh.frame))
    truth = las.read(tile.truth_points, mesh.frame)
    truth = truth.take(slice(None, None, max(1, len(truth) // SAMPLES)))
    points, face, distance = _closest(mesh, truth.xyz)
    on = distance < MESH_DISTANCE_M
    truth, points, normals = truth.take(on), points[on], mesh.face_normal[face[on]]
    assert truth.rgb is not None
    best, colour = np.full(len(points), MAX_TRUTH_RANGE_M, np.float32), np.zeros((len(points), 3), np.float32)
    for i, view in scene.photos(held_out=False).items():
        better = np.flatnonzero(_seen(scene, i, view, points, normals, best))
        to = (truth.xyz[better] - view.centre).astype(np.float32)
        rays = np.concatenate([np.broadcast_to(view.centre.astype(np.float32), to.shape), to], axis=1)
        first = casting.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()  # in multiples of the ray's length
        better = better[np.abs(first - 1) * np.linalg.norm(to, axis=1) < RAY_TOLERANCE_M]
        uv, _ = pixels(view.camera, view.T_world_cam, truth.xyz[better])
        photo = image.read_rgb(view.photo)
        for part in np.array_split(
            np.arange(len(better)), len(better) // 30_000 + 1
        ):  # remap is limited to 32 767 rows
            sampled = cv2.remap(photo, uv[part][:, None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            colour[better[part]] = np.asarray(sampled).reshape(-1, 3)
        best[better] = np.linalg.norm(points[better] - view.centre, axis=1)
    near = best < MAX_TRUTH_RANGE_M
    return Samples(truth.xyz[near], truth.rgb[near], colour[near])


def _casting(mesh: Mesh) -> Any:
    import open3d as o3d

    casting = o3d.t.geometry.RaycastingScene()
    casting.add_triangles(np.ascontiguousarray(mesh.vertices), mesh.faces.astype(np.uint32))
    return casting


def _closest(mesh: Mesh, points: F32) -> tuple[F32, npt.NDArray[np.uint32], F32]:
    """Nearest points on the mesh (N, 3), their faces (N,), and distances in metres (N,)."""
    answer = _casting(mesh).compute_closest_points(np.ascontiguousarray(points))
    points = answer["points"].numpy()
    return points, answer["primitive_ids"].numpy(), np.linalg.norm(points - points, axis=1)


def _seen(scene: Scene, i: int, view: View, points: F32, normals: F32, nearer_than: Any) -> Bools:
    """(N,) whether a view sees points from the front and nearer than a distance in metres."""
    to = (view.centre - points).astype(np.float32)
    distance = np.linalg.norm(to, axis=1)
    facing = np.einsum("ij,ij->i", to, normals) > MIN_INCIDENCE_COS * distance
    seen = facing & (distance < nearer_than)
    at = np.flatnonzero(seen)
    depth = load_depth_map(scene.depth / f"{i}.npy", view.camera, view.T_world_cam)
    seen[at] = visible(depth, points[at], normals[at])
    return seen


def truth_psnr(folder: Path, truth: Samples) -> tuple[float, float, float]:
    """PSNR of a texture against the true colours, without and with a gain per channel; share of textured samples."""
    rgb, seen, _ = Renderer([textured(folder)]).nearest(truth.xyz)
    on = seen == 255
    return *likeness(rgb[on].astype(np.float32), truth.rgb[on].astype(np.float32)), float(on.mean())


def likeness(rgb: F32, truth: F32) -> tuple[float, float]:
    """PSNR (dB) of colours (N, 3) from 0 to 255, without and with the least-squares gain of each channel."""
    return _psnr(rgb, truth), _psnr(np.clip(rgb * gain(rgb, truth), 0, 255), truth)


def gain(rgb: F32, truth: F32) -> F32:
    """(3,) least-squares gains from colours (N, 3) to the truth."""
    return np.asarray((rgb * truth).sum(axis=0) / np.maximum((rgb * rgb).sum(axis=0), 1.0), np.float32)


def _psnr(a: F32, b: F32) -> float:
    error = float(np.mean((a - b) ** 2, dtype=np.float64)) if len(a) else float("nan")
    return float(10 * np.log10(255**2 / max(error, 1e-3)))


class Road:
    """Samples of the road from above, every centimetre, and where the moving car may have left a ghost.

    A ghost is a sample on the road (the nearest true sample of its mesh face belongs to that class) that

    - at least three used photos see, according to the depth maps of the street without the moving car,
    - in at least one of those photos shows the moving car or its shadow: the photo differs there by more than 25 grey
      levels from the photo with the same pose without the car, brought to the same (known) exposure,
    - and whose luminance in the texture of `street_hard`, averaged over 5 x 5 texels, differs by more than 40 grey
      levels from that of the same method's texture of `street_clean`, after a gain per channel solved where no photo
      shows the car.

    So noise and errors that occur without any car don't count; exposure steps where a photo shows the car do. Only
    samples that both textures have from photos are compared; `painted` is their share, as a method may leave some to
    be filled.

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
        # the same ray positions as in Renderer.above
        x, y = self._low[0] + (self._at[1] + 0.5) * TEXEL_M, self._high[1] - (self._at[0] + 0.5) * TEXEL_M
        points = np.stack([x, y, self._high[2] + 1 - bare.range[self._at]], axis=1).astype(np.float32)
        normals = road.face_normal[bare.face[self._at]]
        views = np.zeros(len(points), np.uint8)
        self._car = np.zeros(len(points), bool)
        hard_photos = hard.photos(held_out=False)
        exposure = _exposures(hard)
        for i, view in clean.photos(held_out=False).items():
            seen = np.flatnonzero(_seen(clean, i, view, points, normals, MAX_DISTANCE_M))
            views[seen] += 1
            shows = _car_pixels(view, hard_photos[i], exposure[hard_photos[i].name])
            self._car[seen] |= _at_pixels(shows, view, points[seen])
        self._avoidable = self._car & (views >= MIN_VIEWS)

    def _above(self, body: Body) -> Any:
        width = max(1, int(np.ceil((self._high[0] - self._low[0]) / TEXEL_M)))
        high = self._high.copy()
        high[0] = self._low[0] + width * TEXEL_M
        return Renderer([body]).above(self._low, high, width=width)

    def _read(self, folder: Path) -> tuple[F32, Bools]:
        body = textured(folder)
        picture = self._above(replace(body, mesh=body.mesh.moved_to(self._frame).keep(self._faces)))
        return picture.rgb[self._at].astype(np.float32), picture.seen[self._at] == 255

    def ghosts(self, clean: Path, hard: Path, picture: Path | None = None) -> tuple[int, float]:
        """Number of ghost texels (square centimetres), and share of the avoidable samples that both textures painted.

        Args:
            clean, hard: folders of one method's textures of both streets.
            picture: optional file for an image of `hard` from above at a quarter of the size, ghosts in red.
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
        ghost = painted & self._avoidable & (np.abs(mean[self._at]) > GHOST_LEVELS)
        if picture is not None:
            whole = np.full((*self._shape, 3), 255, np.uint8)
            whole[self._at] = after
            whole[tuple(a[ghost] for a in self._at)] = (255, 0, 0)
            image.write(picture, np.asarray(cv2.resize(whole, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)))
        return int(ghost.sum()), float(painted[self._avoidable].mean()) if self._avoidable.any() else float("nan")

    @property
    def avoidable(self) -> int:
        """Number of samples where a photo shows the car or its shadow, and at least three photos see the road."""
        return int(self._avoidable.sum())


def _road_faces(mesh: Mesh, truth: PointCloud) -> Bools:
    """(F,) whether a face's nearest true sample is near and belongs to the road."""
    from scipy.spatial import cKDTree

    assert truth.classification is not None
    distance, index = cKDTree(truth.xyz).query(mesh.corners.mean(axis=1), workers=-1)
    return (truth.classification[index] == CODE["road"]) & (distance < 2 * MESH_DISTANCE_M)


def _exposures(scene: Scene) -> dict[str, float]:
    """Exposure (EV) by name of the view."""
    lines = (scene.tile / "truth" / "exposures.csv").read_text(encoding="utf-8").splitlines()[1:]
    return {Path(file).with_suffix("").as_posix(): float(ev) for file, ev in (line.split(",") for line in lines)}


def _car_pixels(clean: View, hard: View, ev: float) -> Bools:
    """(H, W) pixels where the photo of `hard` differs from that of `clean` at the same exposure."""
    import cv2

    from scan2sim.data_samples.scene import srgb

    without, photo = image.read_rgb(clean.photo), image.read_rgb(hard.photo)
    expected = srgb(_LINEAR[without] * np.float32(2.0**ev))
    difference = cv2.blur((photo.astype(np.float32) - expected) @ LUMA, (5, 5))
    return np.abs(difference) > CAR_LEVELS


def _at_pixels(mask: Bools, view: View, points: F32) -> Bools:
    """(N,) values of the mask where a view sees points."""
    uv, _ = pixels(view.camera, view.T_world_cam, points)
    column, row = np.rint(np.clip(uv, 0, [view.camera.width - 1, view.camera.height - 1])).astype(int).T
    return mask[row, column]
