"""Independent renderer of a finished world: OBJ and PNG read by trimesh, rays cast by Open3D, no pipeline code."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, U8, Bools

SAMPLES_PER_AXIS = 3
"""Number of rays per pixel in each direction."""
RAYS_PER_BATCH = 400_000
BACKGROUND = (200, 214, 230)
"""Colour of pixels without a hit: a plain sky."""


@dataclass(frozen=True)
class Photo:
    """A posed photo of a pinhole camera.

    Attributes:
        rgb: (H, W, 3) uint8.
        K: (3, 3) intrinsics; (0, 0) is the centre of the first pixel.
        T: (4, 4) camera (x right, y down, z forward) to the world's local frame, metres.
        time: seconds on the cloud's clock.
    """

    rgb: U8
    K: F64
    T: F64
    time: float


@dataclass(frozen=True)
class Rendering:
    """Rendered pixels of a photo's view: `rgb` (H, W, 3) uint8, `range` (H, W) metres, inf without a hit."""

    rgb: U8
    range: F32

    @property
    def hit(self) -> Bools:
        """(H, W) whether the ray through the pixel's centre hits a surface."""
        return np.isfinite(self.range)


class World:
    """The visual meshes in `folder` (the `world` of a run), in the local frame, z up.

    Attributes:
        origin: (3,) origin of the local frame.
        casting: Open3D scene with all meshes.
        vertices, faces: (V, 3) and (F, 3) of all meshes.
    """

    def __init__(self, folder: Path) -> None:
        import open3d as o3d
        import trimesh

        about = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))
        self.origin = np.array(about["origin_m"], np.float64)
        self.casting = o3d.t.geometry.RaycastingScene()
        self._uv: list[npt.NDArray[Any]] = []
        self._page: list[U8] = []
        vertices, faces, count = [], [], 0
        for path in sorted((folder / "models").glob("*/meshes/*.obj")):
            if path.stem == "collision":
                continue
            scene = trimesh.load_scene(path, process=False)
            for mesh in scene.geometry.values():
                corner, face = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)
                self.casting.add_triangles(np.ascontiguousarray(corner), np.ascontiguousarray(face))
                self._uv.append(np.asarray(mesh.visual.uv, np.float32)[face])
                self._page.append(np.asarray(mesh.visual.material.image.convert("RGB"), np.uint8))
                vertices.append(corner)
                faces.append(face.astype(np.int64) + count)
                count += len(corner)
        self.vertices, self.faces = np.concatenate(vertices), np.concatenate(faces)

    def render(self, photo: Photo) -> Rendering:
        """Render the world from a photo's pose: a pixel's colour is the mean over its rays that hit a surface.

        A pixel whose central ray hits nothing is background.
        """
        height, width = photo.rgb.shape[:2]
        row, column = np.divmod(np.arange(height * width), width)
        offset = (np.arange(SAMPLES_PER_AXIS) + 0.5) / SAMPLES_PER_AXIS - 0.5
        rgb = np.tile(np.array(BACKGROUND, np.uint8), (height * width, 1))
        distance = np.full(height * width, np.inf, np.float32)
        for part in np.array_split(
            np.arange(height * width), height * width * SAMPLES_PER_AXIS**2 // RAYS_PER_BATCH + 1
        ):
            distance[part], _ = self._cast(photo, column[part], row[part], colours=False)
            hit = np.isfinite(distance[part])
            total, hits = np.zeros((hit.sum(), 3)), np.zeros(hit.sum())
            for down in offset:
                for across in offset:
                    far, colour = self._cast(photo, column[part][hit] + across, row[part][hit] + down)
                    total += colour
                    hits += np.isfinite(far)
            mean = np.round(total / np.maximum(hits, 1)[:, None]).astype(np.uint8)
            rgb[part[hit]] = np.where(hits[:, None] > 0, mean, rgb[part[hit]])
        return Rendering(rgb.reshape(height, width, 3), distance.reshape(height, width))

    def _cast(
        self, photo: Photo, column: npt.NDArray[Any], row: npt.NDArray[Any], *, colours: bool = True
    ) -> tuple[F32, F64]:
        """Distances (N,) to the hits of rays through a photo's pixels, and colours (N, 3), black without a hit."""
        import open3d as o3d

        way = np.stack([column, row, np.ones(len(row))], axis=1) @ np.linalg.inv(photo.K).T
        way = way / np.linalg.norm(way, axis=1, keepdims=True) @ photo.T[:3, :3].T
        rays = np.concatenate([np.broadcast_to(photo.T[:3, 3], way.shape), way], axis=1).astype(np.float32)
        hits = self.casting.cast_rays(o3d.core.Tensor(rays))
        distance = hits["t_hit"].numpy()
        rgb = np.zeros((len(rays), 3))
        if colours:
            which, face, weight = (hits[k].numpy() for k in ("geometry_ids", "primitive_ids", "primitive_uvs"))
            for k in range(len(self._uv)):
                at = np.flatnonzero(np.isfinite(distance) & (which == k))
                b, c = weight[at].T
                uv = np.einsum("nkj,nk->nj", self._uv[k][face[at]], np.stack([1 - b - c, b, c], axis=1))
                rgb[at] = _sample(self._page[k], uv)
        return distance, rgb

    def distance(self, places: F64) -> F32:
        """(N,) distances in metres from positions (N, 3), local, to the nearest surface."""
        return np.asarray(self.casting.compute_distance(np.ascontiguousarray(places, np.float32)).numpy())


def _sample(page: U8, uv: npt.NDArray[Any]) -> F64:
    """Bilinear colours (N, 3) of an image at uv (N, 2); (0, 0) is the lower left corner."""
    height, width = page.shape[:2]
    x = np.clip(uv[:, 0] * width - 0.5, 0, width - 1.001)
    y = np.clip((1 - uv[:, 1]) * height - 0.5, 0, height - 1.001)
    left, top = x.astype(np.int64), y.astype(np.int64)
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    x, y = (x - left)[:, None], (y - top)[:, None]
    upper = page[top, left] * (1 - x) + page[top, right] * x
    return np.asarray(upper * (1 - y) + (page[below, left] * (1 - x) + page[below, right] * x) * y, np.float64)


def photos(tile: Path, run: Path, origin: F64) -> dict[int, Photo]:
    """All photos of an imported street by frame number, read from its `tile.toml`.

    Poses refined by the run (step `pose_refinement`) are used if available, since the world is built in their frame.
    """
    from PIL import Image

    about = tomllib.loads((tile / "tile.toml").read_text(encoding="utf-8"))
    cameras = {camera["id"]: camera for camera in about["cameras"]}
    refined = _refined(run)
    out = {}
    for entry in about["photos"]:
        camera, name = cameras[entry["camera"]], Path(entry["file"])
        K = np.array([[camera["focal"][0], 0, camera["centre"][0]], [0, camera["focal"][1], camera["centre"][1]]])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.array(entry["rotation"]), np.array(entry["position"]) - origin
        K, T = refined.get(name.with_suffix("").as_posix(), (np.vstack([K, [0, 0, 1]]), T))
        rgb = np.asarray(Image.open(tile / name).convert("RGB"), np.uint8)
        out[int(name.stem)] = Photo(rgb, K, T, float(entry["time"]))
    return out


def _refined(run: Path) -> dict[str, tuple[F64, F64]]:
    """Refined intrinsics and poses (local metres) by the photo's name; empty if the run has none."""
    out = {}
    for path in sorted((run / "steps" / "pose_refinement").glob("*/views.json")):
        for view in json.loads(path.read_text(encoding="utf-8")):
            fx, fy, cx, cy = (view["camera"][k] for k in ("fx", "fy", "cx", "cy"))
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)
            out[view["name"]] = (K, np.array(view["T_world_cam"], np.float64))
    return out
