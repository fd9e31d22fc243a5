"""Baseline texturing methods, on the same mesh, atlas and photos as ours.

Each writes the same files as the step `texture`: `mesh.npz`, `page_<i>.png`, `page_<i>_seen.png`.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numba import njit, prange

from bench.texture.scenes import Scene
from scan2sim.pipeline.camera.depth_map import RANGE_BIAS_M, load_depth_map
from scan2sim.pipeline.camera.image_sampling import bilinear
from scan2sim.pipeline.camera.models import EQUIRECTANGULAR
from scan2sim.pipeline.camera.projection import (
    PosedCamera,
    Ranges,
    incidence,
    is_visible,
    pixel_of,
    posed_camera,
    rotate_to_camera,
    to_camera,
)
from scan2sim.pipeline.core.types import F32, I32, I64, U8, Mesh
from scan2sim.pipeline.io.images import image
from scan2sim.texturing import texel_map
from scan2sim.texturing.inpainting import hole_filling

OPEN3D_SIZE = 4096
PADDING = 16
MAX_DISTANCE_M, MIN_INCIDENCE_COS = 40.0, 0.08
"""Maximum distance and minimum cosine (normal to ray) at which a photo is used for a surface, as in ours."""


def parametrize(scene: Scene, out: Path) -> None:
    """Plain unwrapping of the whole mesh by xatlas; only its cost is of interest."""
    import xatlas

    mesh = Mesh.load(scene.mesh)
    xatlas.parametrize(mesh.vertices, mesh.faces.astype(np.uint32))


def open3d(scene: Scene, out: Path) -> None:
    """Open3D's `project_images_to_albedo` with the perspective photos, undistorted; it supports no other cameras.

    It textures a single atlas: several pages of ours become a grid. Black texels are those without colour.
    """
    import cv2
    import open3d as o3d

    mesh = _one_atlas(Mesh.load(scene.atlas / "mesh.npz"))
    assert mesh.uv is not None
    body = o3d.t.geometry.TriangleMesh(mesh.vertices, mesh.faces.astype(np.int64))
    body.triangle.texture_uvs = o3d.core.Tensor(np.ascontiguousarray(mesh.uv))
    photos, intrinsics, extrinsics = [], [], []
    for view in scene.photos(held_out=False).values():
        camera, photo = view.camera, image.read_rgb(view.photo)
        if camera.model not in ("pinhole", "opencv"):
            continue
        k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
        if camera.distortion:
            photo = np.asarray(cv2.undistort(photo, k, np.array(camera.distortion)))
        photos.append(o3d.t.geometry.Image(np.ascontiguousarray(photo)))
        intrinsics.append(o3d.core.Tensor(k))
        extrinsics.append(o3d.core.Tensor(np.linalg.inv(view.T_world_cam)))
    albedo = body.project_images_to_albedo(photos, intrinsics, extrinsics, OPEN3D_SIZE, True)
    rgb = np.ascontiguousarray(albedo.as_tensor().numpy()[..., :3])
    owner = texel_map.owners(texel_map.corners(mesh.uv, OPEN3D_SIZE, OPEN3D_SIZE), OPEN3D_SIZE, OPEN3D_SIZE)
    seen = np.where((owner >= 0) & rgb.any(axis=2), 255, 0).astype(np.uint8)
    mesh.save(out / "mesh.npz")
    _write(out, 0, rgb, seen)


def _one_atlas(mesh: Mesh) -> Mesh:
    """The mesh with its pages arranged as a square grid on one page."""
    assert mesh.uv is not None and mesh.page is not None
    side = math.ceil(math.sqrt(int(mesh.page.max()) + 1))
    cell = np.stack([mesh.page % side, mesh.page // side], axis=1)[:, None]
    return replace(mesh, uv=((mesh.uv + cell) / side).astype(np.float32), page=np.zeros_like(mesh.page))


def nearest(scene: Scene, out: Path) -> None:
    """Each texel from the nearest photo that sees it."""
    _paint(scene, out, only_nearest=True)


def inverse_square(scene: Scene, out: Path) -> None:
    """Each texel as the mean of all photos that see it, weighted by the inverse square of their distance."""
    _paint(scene, out, only_nearest=False)


def _paint(scene: Scene, out: Path, *, only_nearest: bool) -> None:
    mesh = Mesh.load(scene.atlas / "mesh.npz")
    assert mesh.uv is not None and mesh.page is not None
    corners, normals = mesh.corners, mesh.face_normal
    for k, size in enumerate(json.loads((scene.atlas / "pages.json").read_text(encoding="utf-8"))):
        width, height = size["width"], size["height"]
        faces = np.flatnonzero(mesh.page == k)
        flat = texel_map.corners(mesh.uv[faces], width, height)
        owner = texel_map.owners(flat, width, height)
        at = np.nonzero(owner >= 0)
        face = owner[at]
        points = _points(flat, corners[faces], face, *at)
        total = np.zeros((len(face), 4), np.float32)
        for i, view in scene.photos(held_out=False).items():
            photo = image.read_rgb(view.photo)
            depth = load_depth_map(scene.depth / f"{i}.npy", view.camera, view.T_world_cam)
            _add(
                total, points, normals[faces], face, photo, posed_camera(view.camera, view.T_world_cam), depth.ranges,
                RANGE_BIAS_M, MAX_DISTANCE_M, MIN_INCIDENCE_COS, only_nearest,
            )  # fmt: skip
        rgb, seen = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.uint8)
        rgb[at] = np.rint(total[:, :3] / np.maximum(total[:, 3:], 1e-12))
        seen[at] = np.where(total[:, 3] > 0, 255, 0)
        _write(out, k, rgb, seen)
    mesh.save(out / "mesh.npz")


def _write(out: Path, page: int, rgb: U8, seen: U8) -> None:
    hole_filling.pad(rgb, seen, PADDING)
    image.write(out / f"page_{page}.png", rgb)
    image.write(out / f"page_{page}_seen.png", seen)


@njit(cache=True, parallel=True)
def _points(flat: F32, corners: F32, face: I32, rows: I64, columns: I64) -> F32:
    """(N, 3) float32 positions of the texels."""
    out = np.empty((len(face), 3), np.float32)
    for i in prange(len(face)):
        origin, per_x, per_y, _ = texel_map.frame(flat, corners, face[i])
        for k in range(3):
            out[i, k] = origin[k] + columns[i] * per_x[k] + rows[i] * per_y[k]
    return out


@njit(cache=True, parallel=True)
def _add(
    total: F32,
    points: F32,
    normals: F32,
    face: I32,
    photo: U8,
    camera: PosedCamera,
    ranges: Ranges,
    bias: float,
    max_distance: float,
    min_cos: float,
    only_nearest: bool,
) -> None:
    """Add a photo's weighted colour to the texels (N, 4) that it sees, or replace that of a farther photo."""
    for i in prange(len(points)):
        place, normal = points[i], normals[face[i]]
        x, y, z = to_camera(camera.T, place[0], place[1], place[2])
        nx, ny, nz = rotate_to_camera(camera.T, normal[0], normal[1], normal[2])
        r, cos = incidence(camera, x, y, z, nx, ny, nz)
        if r > max_distance or cos < min_cos:
            continue
        u, v, ok = pixel_of(camera, x, y, z)
        if not ok or not is_visible(camera, ranges, u, v, r, cos, bias):
            continue
        w = 1.0 / (r * r)
        if only_nearest:
            if w <= total[i, 3]:
                continue
            total[i, :] = 0
        rgb = bilinear(photo, u, v, camera.model == EQUIRECTANGULAR)
        for k in range(3):
            total[i, k] += w * rgb[k]
        total[i, 3] += w
