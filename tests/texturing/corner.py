"""Synthetic street corner: ground and a box with known colours, photographed by any camera."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.camera.depth_map import depth_map, scene
from scan2sim.pipeline.camera.renderer import Body, Renderer, look_at, pinhole
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F32, F64, U8, Camera, Frame, Mesh, PointCloud, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.exposure import EXPOSURE
from scan2sim.texturing.photo_consistency import PHOTO_CONSISTENCY
from scan2sim.texturing.texture import TextureParams, texture
from scan2sim.texturing.texture_layout import UnwrapParams
from scan2sim.texturing.unwrap import unwrap
from scan2sim.texturing.view_selection.step import VIEW_SELECTION
from tests.fakes.steps import step_params


def grid(
    corner: tuple[float, float, float], along: tuple[float, float, float], up: tuple[float, float, float], n: int = 12
) -> tuple[F64, npt.NDArray[np.int64]]:
    """Rectangle of n x n cells from `corner`, spanned by two vectors; its front faces the direction along x up."""
    s, t = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
    vertices = np.asarray(corner) + s.reshape(-1, 1) * np.asarray(along) + t.reshape(-1, 1) * np.asarray(up)
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a = (i * (n + 1) + j).ravel()
    faces = np.concatenate([np.column_stack([a, a + n + 1, a + n + 2]), np.column_stack([a, a + n + 2, a + 1])])
    return vertices, faces


def join(*parts: tuple[npt.NDArray[Any], npt.NDArray[Any]]) -> Mesh:
    at = 0
    vertices, faces = [], []
    for v, f in parts:
        vertices.append(v)
        faces.append(f + at)
        at += len(v)
    return Mesh(Frame(), np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32))


GROUND = join(grid((-5, -5, 0), (10, 0, 0), (0, 10, 0), 24))
BOX = join(
    grid((0, -1, 0), (0, 0, 2), (0, 2, 0)),  # facing -x, where cameras are
    grid((1, -1, 0), (0, 2, 0), (0, 0, 2)),
    grid((0, -1, 0), (1, 0, 0), (0, 0, 2)),
    grid((0, 1, 0), (0, 0, 2), (1, 0, 0)),
    grid((0, -1, 2), (1, 0, 0), (0, 2, 0)),
)


def paint(xyz: npt.ArrayLike) -> F64:
    """(N, 3) colour of the surface at points (N, 3): soft stripes on the ground, the box is red."""
    x, y, z = np.moveaxis(np.asarray(xyz, float), -1, 0)
    ground = np.stack([60 + 40 * np.sin(3 * x), 120 + 50 * np.sin(2.5 * y + x), 130 + 60 * np.cos(2 * x - y)], axis=-1)
    red = np.stack([220 + 20 * np.sin(4 * z + y), 40 + 20 * np.sin(3 * y + x), 40 + 0 * z], axis=-1)
    return np.where((z > 0.01)[..., None], red, ground)


CORNER = (GROUND, BOX)


def photograph(camera: Camera, pose: F64, meshes: tuple[Mesh, ...] = CORNER, gain: float = 1.0) -> U8:
    """(H, W, 3) uint8 rendering of the surface colours from a camera."""
    if meshes is CORNER:
        return _photo_of_corner(camera, pose.astype(float).tobytes(), gain).copy()
    return _rendered(camera, pose, meshes, gain)


@lru_cache(maxsize=50)
def _photo_of_corner(camera: Camera, pose: bytes, gain: float) -> U8:
    """Rendered once for all tests of a process."""
    return _rendered(camera, np.frombuffer(pose).reshape(4, 4), CORNER, gain)


def _rendered(camera: Camera, pose: F64, meshes: tuple[Mesh, ...], gain: float) -> U8:
    from scan2sim.pipeline.camera.models import pixel_rays, ray_origins

    image = Renderer([Body(mesh) for mesh in meshes]).view(camera, pose)
    v, u = np.mgrid[: camera.height, : camera.width]
    begin = ray_origins(camera, np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 3)
    hit = (begin + pixel_rays(camera) * np.where(image.hit, image.range, 0)[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    rgb = np.where(image.hit[..., None], paint(hit) * gain, [200, 214, 230])
    return np.clip(np.round(rgb), 0, 255).astype(np.uint8)


CAMERAS = {
    "pinhole": pinhole(640, 480, field=80),
    "opencv": Camera("opencv", 640, 480, 380.0, 380.0, 319.5, 239.5, (-0.15, 0.03, 0.0005, -0.0005)),
    "fisheye": Camera("fisheye", 640, 640, 220.0, 220.0, 319.5, 319.5, (0.02, -0.003, 0.0, 0.0)),
    "equirectangular": Camera("equirectangular", 1600, 800),
}
POSES = [look_at((-4, y, 1.8), (0, y / 2, 0.6)) for y in (-3.0, -1.0, 1.0, 3.0)]


@dataclass
class Street:
    """All inputs of the step `texture`, in a folder; fields may be changed before `run`."""

    folder: Path
    mesh: Mesh = GROUND
    occluders: tuple[Mesh, ...] = (GROUND, BOX)
    views: list[View] = field(default_factory=list)
    held_out: tuple[bool, ...] = ()
    clouds: dict[str, PointCloud] = field(default_factory=dict)
    slim: F32 = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    files: dict[str, Path] = field(default_factory=dict)
    labels: Path | None = None
    texel: float = 0.02
    page_size: int = 4096
    runs: int = 0

    def add(self, camera: Camera, pose: F64, image: U8 | None = None, mask: U8 | None = None) -> View:
        """Add a rendered photo, or `image` in its place."""
        name = f"photo{len(self.views)}"
        path = self.folder / f"{name}.png"
        cv2.imwrite(str(path), (photograph(camera, pose) if image is None else image)[..., ::-1])
        view = View(name, camera, pose, path)
        if mask is not None:
            view = replace(view, mask=self.folder / f"{name}_mask.png")
            cv2.imwrite(str(view.mask), mask)
        self.views.append(view)
        return view

    def run(
        self,
        exposure: dict[str, Any] | None = None,
        agreement: dict[str, Any] | None = None,
        choose: dict[str, Any] | None = None,
        **params: Any,
    ) -> tuple[Path, Done]:
        """Unwrap and texture with settings by step; returns (folder of the textured mesh, the steps' results)."""
        out = self.folder / f"run{self.runs}"
        self.runs += 1
        (out / "depth").mkdir(parents=True)
        self.mesh.save(out / "in.npz")
        settings = UnwrapParams(backend="xatlas", texel=self.texel, page_size=self.page_size)
        flat = unwrap({"mesh": out / "in.npz"}, settings, out, silent)
        occluders = replace(scene(self.occluders), slim=self.slim, slim_radius=0.05)
        for i, view in enumerate(self.views):
            np.save(out / "depth" / f"{i}.npy", depth_map(view.camera, view.T_world_cam, occluders).range)
        views_io.save(out / "views.json", self.views, self.held_out)
        inputs = {**flat.files, "views": out / "views.json", "depth": out / "depth"}
        inputs |= {"labels": self.labels} if self.labels else {}
        warnings: list[str] = []
        for step, given in ((EXPOSURE, exposure), (PHOTO_CONSISTENCY, agreement), (VIEW_SELECTION, choose)):
            done = step.run(inputs, step_params(step.params, **(given or {})), out, silent)
            inputs |= done.files
            warnings += done.warnings
        for name, cloud in self.clouds.items():
            cloud.save(out / f"{name}.npz")
            inputs[f"cloud.{name}"] = out / f"{name}.npz"
        inputs |= self.files
        done = texture(inputs, TextureParams(**params), out, silent)
        return done.files["textured"], replace(done, warnings=warnings + done.warnings)


def points(colour: bool = True, n: int = 40_000, rgb: tuple[int, int, int] | None = None) -> PointCloud:
    """Points all over the ground with its colours, or with one colour."""
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-5, 5, (n, 2)), np.zeros(n)]).astype(np.float32)
    colours = np.clip(paint(xyz), 0, 255).astype(np.uint8) if rgb is None else np.tile(np.array(rgb, np.uint8), (n, 1))
    normal = np.tile(np.array([0, 0, 1], np.float32), (n, 1))
    return PointCloud(Frame(), xyz, colours if colour else None, normal, np.full(n, 11, np.uint8))
