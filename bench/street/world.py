"""Independent renderer of a finished world: OBJ and PNG read by trimesh, rays cast by Open3D, no pipeline code."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, I32, U8, Bools

LENS_MARGIN = 1.1
"""Radius up to which the distortion is used, over that of the image corners."""
SAMPLES_PER_AXIS = 3
"""Number of rays per pixel in each direction."""
RAYS_PER_BATCH = 400_000
BACKGROUND = (200, 214, 230)
"""Colour of pixels without a hit, for worlds that don't have one (`sky_rgb` in metadata.json): a plain sky."""


@dataclass(frozen=True)
class Photo:
    """A posed photo of a pinhole camera.

    Attributes:
        rgb: (H, W, 3) uint8.
        K: (3, 3) intrinsics; (0, 0) is the centre of the first pixel.
        T: (4, 4) camera (x right, y down, z forward) to the world's local frame, metres.
        time: seconds on the cloud's clock.
        distortion: (N,) OpenCV's coefficients k1, k2, p1, p2, ...
    """

    rgb: U8
    K: F64
    T: F64
    time: float
    distortion: tuple[float, ...] = ()

    def rays(self, column: npt.NDArray[Any], row: npt.NDArray[Any]) -> F64:
        """Directions (N, 3) of the rays through pixels, camera axes, 1 m forward."""
        import cv2

        way = np.stack([column, row, np.ones(len(row))], axis=1) @ np.linalg.inv(self.K).T
        if any(self.distortion) and len(way):
            way[:, :2] = cv2.undistortPoints(way[:, None, :2], np.eye(3), np.array(self.distortion))[:, 0]
        return way

    def pixels(self, local: F64) -> F64:
        """Pixels (N, 2) of points (N, 3) in front of the camera, camera axes.

        The distortion is undefined far outside the image, where its polynomial turns back: such points are without it.
        """
        import cv2

        flat = local[:, :2] / local[:, 2:]
        if any(self.distortion) and len(flat):
            height, width = self.rgb.shape[:2]
            corners = self.rays(np.array([0.0, width - 1, 0, width - 1]), np.array([0.0, 0, height - 1, height - 1]))
            defined = np.linalg.norm(flat, axis=1) < LENS_MARGIN * np.linalg.norm(corners[:, :2], axis=1).max()
            ahead = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
            distorted, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), np.eye(3), np.array(self.distortion))
            flat = np.where(defined[:, None], distorted[:, 0], flat)
        return np.asarray(flat @ self.K[:2, :2].T + self.K[:2, 2], np.float64)


@dataclass(frozen=True)
class Rendering:
    """Rendered pixels of a photo's view.

    Attributes:
        rgb: (H, W, 3) uint8 of the surfaces, with the colour of the sky where there is none.
        range: (H, W) metres to the surface, inf without a hit.
        surface: (H, W) index into `World.surfaces` of the geometry that the pixel shows, -1 without a hit.
        whole: (H, W, 3) uint8 as a camera in a simulator sees it: surfaces and backdrop, whichever is nearer.
        backdrop: (H, W) metres to the backdrop's layers, inf at its dome, where it has nothing, and where a surface is
            nearer.
    """

    rgb: U8
    range: F32
    surface: I32
    whole: U8
    backdrop: F32

    @property
    def hit(self) -> Bools:
        """(H, W) whether the ray through the pixel's centre hits a surface."""
        return np.isfinite(self.range)


class Meshes:
    """Textured OBJ meshes, cast by Open3D.

    Args:
        paths: OBJ files with UV coordinates and a texture page for each material.
        keep: function of the faces' UV coordinates (F, 3, 2) and their page that returns which are kept; None: all.

    Attributes:
        casting: Open3D scene with all meshes.
        names: stem of the file of each geometry in `casting`.
        vertices, faces: (V, 3) and (F, 3) of all meshes.
    """

    def __init__(self, paths: Sequence[Path], keep: Callable[[npt.NDArray[Any], U8], Bools] | None = None) -> None:
        import open3d as o3d
        import trimesh

        self.casting = o3d.t.geometry.RaycastingScene()
        self.names: list[str] = []
        self._uv: list[npt.NDArray[Any]] = []
        self._page: list[U8] = []
        vertices: list[F32] = [np.zeros((0, 3), np.float32)]
        faces, count = [np.zeros((0, 3), np.int64)], 0
        for path in paths:
            scene = trimesh.load_scene(path, process=False)
            for mesh in scene.geometry.values():
                corner, face = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)
                uv = np.asarray(mesh.visual.uv, np.float32)[face]
                page = np.asarray(mesh.visual.material.image.convert("RGB"), np.uint8)
                if keep is not None:
                    kept = keep(uv, page)
                    face, uv = face[kept], uv[kept]
                if not len(face):
                    continue
                self.casting.add_triangles(np.ascontiguousarray(corner), np.ascontiguousarray(face))
                self.names.append(path.stem)
                self._uv.append(uv)
                self._page.append(page)
                vertices.append(corner)
                faces.append(face.astype(np.int64) + count)
                count += len(corner)
        self.vertices, self.faces = np.concatenate(vertices), np.concatenate(faces)

    def __len__(self) -> int:
        return len(self.faces)

    def render(self, photo: Photo, background: Sequence[int]) -> tuple[U8, F32, I32]:
        """Colours (H, W, 3), distances (H, W) and geometries (H, W) from a photo's pose.

        A pixel's colour is the mean over its rays that hit a mesh; where its central ray hits nothing, it is
        `background`, at an infinite distance, of the geometry -1.
        """
        height, width = photo.rgb.shape[:2]
        row, column = np.divmod(np.arange(height * width), width)
        offset = (np.arange(SAMPLES_PER_AXIS) + 0.5) / SAMPLES_PER_AXIS - 0.5
        rgb = np.tile(np.array(background, np.uint8), (height * width, 1))
        distance, geometry = np.full(len(row), np.inf, np.float32), np.full(len(row), -1, np.int32)
        for part in np.array_split(np.arange(len(row)), len(row) * SAMPLES_PER_AXIS**2 // RAYS_PER_BATCH + 1):
            distance[part], geometry[part], _ = self._cast(photo, column[part], row[part], colours=False)
            hit = np.isfinite(distance[part])
            total, hits = np.zeros((hit.sum(), 3)), np.zeros(hit.sum())
            for down in offset:
                for across in offset:
                    far, _, colour = self._cast(photo, column[part][hit] + across, row[part][hit] + down)
                    total += colour
                    hits += np.isfinite(far)
            mean = np.round(total / np.maximum(hits, 1)[:, None]).astype(np.uint8)
            rgb[part[hit]] = np.where(hits[:, None] > 0, mean, rgb[part[hit]])
        shape = height, width
        return rgb.reshape(*shape, 3), distance.reshape(shape), geometry.reshape(shape)

    def _cast(
        self, photo: Photo, column: npt.NDArray[Any], row: npt.NDArray[Any], *, colours: bool = True
    ) -> tuple[F32, I32, F64]:
        """Hits of rays through a photo's pixels: distances and geometries (N,), and colours (N, 3), black without."""
        import open3d as o3d

        way = photo.rays(column, row)
        way = way / np.linalg.norm(way, axis=1, keepdims=True) @ photo.T[:3, :3].T
        rays = np.concatenate([np.broadcast_to(photo.T[:3, 3], way.shape), way], axis=1).astype(np.float32)
        hits = self.casting.cast_rays(o3d.core.Tensor(rays))
        distance = hits["t_hit"].numpy()
        geometry = np.where(np.isfinite(distance), hits["geometry_ids"].numpy().astype(np.int32), np.int32(-1))
        rgb = np.zeros((len(rays), 3))
        if colours:
            face, weight = (hits[k].numpy() for k in ("primitive_ids", "primitive_uvs"))
            for k in range(len(self._uv)):
                at = np.flatnonzero(geometry == k)
                b, c = weight[at].T
                uv = np.einsum("nkj,nk->nj", self._uv[k][face[at]], np.stack([1 - b - c, b, c], axis=1))
                rgb[at] = sample(self._page[k], uv)
        return distance, geometry, rgb


class World:
    """The visual meshes in `folder` (the `world` of a run), in the local frame, z up.

    Surfaces are what is there: sensors are measured on them. The backdrop (`backdrop*.obj`) is what only cameras see:
    the sky, and what is too far or too high for the scan.

    Attributes:
        origin: (3,) origin of the local frame.
        sky: colour of what neither a surface nor the backdrop covers.
        meshes, backdrop: the surfaces, and the backdrop, if there is one.
        casting, vertices, faces: of the surfaces (`Meshes`).
        surfaces: name of the surface (terrain, building, vegetation, vehicle) of each geometry in `casting`.
    """

    def __init__(self, folder: Path) -> None:
        about = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))
        self.origin = np.array(about["origin_m"], np.float64)
        self.sky = tuple(about.get("sky_rgb", BACKGROUND))
        model = next(path.parent for path in (folder / "models").rglob("terrain*.obj"))  # not those of actors
        visuals = [path for path in sorted(model.glob("*.obj")) if not path.stem.startswith("collision")]
        self.meshes = Meshes([path for path in visuals if not path.stem.startswith("backdrop")])
        self.backdrop = Meshes([path for path in visuals if path.stem.startswith("backdrop")])
        self.casting, self.vertices, self.faces = self.meshes.casting, self.meshes.vertices, self.meshes.faces
        self.surfaces = [name.split("_")[0] for name in self.meshes.names]

    def render(self, photo: Photo) -> Rendering:
        """Render the world from a photo's pose, with 3 x 3 rays per pixel (`Meshes.render`)."""
        rgb, distance, geometry = self.meshes.render(photo, self.sky)
        whole, layers = rgb, np.full(distance.shape, np.inf, np.float32)
        if len(self.backdrop):
            behind, behind_distance, part = self.backdrop.render(photo, self.sky)
            whole = np.where((behind_distance < distance)[..., None], behind, rgb)
            is_layer = np.array([not name.endswith("sky") for name in self.backdrop.names] + [False])[part]
            layers = np.where(is_layer & (behind_distance < distance), behind_distance, layers)
        return Rendering(rgb, distance, geometry, whole, layers)

    def distance(self, places: F64) -> F32:
        """(N,) distances in metres from positions (N, 3), local, to the nearest surface."""
        return np.asarray(self.casting.compute_distance(np.ascontiguousarray(places, np.float32)).numpy())


def sample(page: U8, uv: npt.NDArray[Any]) -> F64:
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
        given = np.vstack([K, [0, 0, 1]]), T, tuple(camera.get("distortion", ()))
        K, T, distortion = refined.get(name.with_suffix("").as_posix(), given)
        rgb = np.asarray(Image.open(tile / name).convert("RGB"), np.uint8)
        out[int(name.stem)] = Photo(rgb, K, T, float(entry["time"]), distortion)
    return out


def _refined(run: Path) -> dict[str, tuple[F64, F64, tuple[float, ...]]]:
    """Refined intrinsics, poses (local metres) and distortions by the photo's name; empty if the run has none."""
    out = {}
    found = (run / "steps" / "pose_refinement").glob("*/cameras.json")
    for path in sorted(found, key=lambda path: path.stat().st_mtime):  # the newest is that of the world
        for view in json.loads(path.read_text(encoding="utf-8")):
            fx, fy, cx, cy = (view["camera"][k] for k in ("fx", "fy", "cx", "cy"))
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)
            out[view["name"]] = (K, np.array(view["T_world_cam"], np.float64), tuple(view["camera"]["distortion"]))
    return out
