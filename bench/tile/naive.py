"""Straightforward baseline: Open3D for all geometry, xatlas, and Open3D's albedo projection.

Run as `python -m bench.tile.naive TILE OUT`; writes OUT/naive.json with seconds per step, and the meshes.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import laspy
import numpy as np
import open3d as o3d
import xatlas

from scan2sim.pipeline.core.classes import GROUPS, group_of
from scan2sim.pipeline.core.types import Mesh, View
from scan2sim.pipeline.io.tile import read_tile

TARGETS = {"terrain": 100_000, "building": 100_000, "vegetation": 300_000}
MAX_EDGE = {"terrain": 0.5, "building": 0.25, "vegetation": 0.25}
TEXTURE_SIZE = 4096
seconds: dict[str, float] = {}


@contextmanager
def timed(step: str) -> Iterator[None]:
    """Add the time of a block to a step's seconds."""
    start = time.perf_counter()
    yield
    seconds[step] = seconds.get(step, 0.0) + time.perf_counter() - start
    print(f"  naive {step:<10} {seconds[step]:7.1f} s", flush=True)


def main(tile_path: Path, out: Path) -> None:
    """Build a textured OBJ per class from the tile's first cloud and its perspective photos."""
    out.mkdir(parents=True, exist_ok=True)
    tile = read_tile(tile_path)
    with timed("read"):
        las = laspy.read(tile.clouds[0])
        xyz = las.xyz - np.array(tile.frame.origin)
        group = group_of()[np.asarray(las.classification)]
    centre = np.mean([view.centre for view in tile.views], axis=0)
    for i, name in enumerate(GROUPS):
        with timed("split"):
            points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz[group == i]))
        with timed("voxel"):
            points = points.voxel_down_sample(0.1)
        with timed("normals"):
            points.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=0.3, max_nn=30))
            points.orient_normals_towards_camera_location(centre)
        with timed("poisson"):
            mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(points, depth=11)
        with timed("trim"):
            density = np.asarray(density)
            mesh.remove_vertices_by_mask(density < np.quantile(density, 0.05))
            corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
            edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
            mesh.remove_triangles_by_mask(edge > MAX_EDGE[name])
            mesh.remove_unreferenced_vertices()
        with timed("islands"):
            cluster, _, area = mesh.cluster_connected_triangles()
            mesh.remove_triangles_by_mask(np.asarray(area)[np.asarray(cluster)] < 0.5)
            mesh.remove_unreferenced_vertices()
        with timed("decimate"):
            mesh = mesh.simplify_quadric_decimation(TARGETS[name])
        vertices = np.asarray(mesh.vertices, np.float32)
        faces = np.asarray(mesh.triangles, np.int32)
        Mesh(tile.frame, vertices, faces).save(out / f"{name}.npz")
        with timed("unwrap"):
            mapping, indices, uvs = xatlas.parametrize(vertices, faces.astype(np.uint32))
        with timed("texture"):
            texture(out / name, vertices[mapping], indices, uvs, tile.views)
    (out / "naive.json").write_text(json.dumps(seconds), encoding="utf-8")


def texture(path: Path, vertices: np.ndarray, faces: np.ndarray, uvs: np.ndarray, views: tuple[View, ...]) -> None:
    """Project the perspective photos (distortion removed) and write OBJ and PNG."""
    mesh = o3d.t.geometry.TriangleMesh(vertices, faces.astype(np.int64))
    mesh.triangle.texture_uvs = o3d.core.Tensor(np.ascontiguousarray(uvs[faces], np.float32))
    images, intrinsics, extrinsics = [], [], []
    for view in views:
        camera = view.camera
        if camera.model not in ("pinhole", "opencv"):
            continue  # Open3D's projection supports perspective photos only
        k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
        photo = cv2.imread(str(view.photo))[:, :, ::-1]
        if camera.distortion:
            photo = cv2.undistort(photo, k, np.array(camera.distortion))
        images.append(o3d.t.geometry.Image(np.ascontiguousarray(photo)))
        intrinsics.append(o3d.core.Tensor(k))
        extrinsics.append(o3d.core.Tensor(np.linalg.inv(view.T_world_cam)))
    albedo = mesh.project_images_to_albedo(images, intrinsics, extrinsics, TEXTURE_SIZE, True)
    mesh.material.set_default_properties()
    mesh.material.texture_maps["albedo"] = albedo
    cv2.imwrite(str(path.with_suffix(".png")), np.asarray(albedo.as_tensor().numpy())[:, :, 2::-1])
    o3d.t.io.write_triangle_mesh(str(path.with_suffix(".obj")), mesh)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
