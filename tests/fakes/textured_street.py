"""A street of textured planes with photos along it, and its point cloud: quick to render, with known poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from scan2sim.pipeline.camera.models import pixel_rays
from scan2sim.pipeline.core.types import F64, U8, Camera, Frame, PointCloud
from scan2sim.pipeline.io.clouds import las

TEXEL_M = 0.03
SIZE = (480, 360)
FOCAL = 400.0
CAMERA = Camera("pinhole", *SIZE, FOCAL, FOCAL, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)


@dataclass(frozen=True)
class Quad:
    """A rectangle with `corner`, edges `u` and `v` (metres), and a grey texture."""

    corner: F64
    u: F64
    v: F64
    texture: U8

    @classmethod
    def of(cls, corner: list[float], u: list[float], v: list[float], seed: int) -> Quad:
        """A rectangle with a random texture of several scales."""
        random = np.random.default_rng(seed)
        width, height = (int(np.linalg.norm(edge) / TEXEL_M) for edge in (u, v))
        texture = np.zeros((height, width), np.float32)
        for cell, weight in ((1.2, 40), (0.4, 40), (0.12, 40)):
            small = random.normal(size=(int(height * TEXEL_M / cell) + 2, int(width * TEXEL_M / cell) + 2))
            texture += weight * cv2.resize(small.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)
        return cls(np.array(corner), np.array(u), np.array(v), np.clip(texture + 128, 0, 255).astype(np.uint8))


def box(x: float, y: float, size: float, height: float, seed: int) -> list[Quad]:
    """The four sides of a box on the ground."""
    return [
        Quad.of([x, y, 0], [size, 0, 0], [0, 0, height], seed),
        Quad.of([x, y + size, 0], [size, 0, 0], [0, 0, height], seed + 1),
        Quad.of([x, y, 0], [0, size, 0], [0, 0, height], seed + 2),
        Quad.of([x + size, y, 0], [0, size, 0], [0, 0, height], seed + 3),
    ]


def street() -> list[Quad]:
    """Ground, two facades, an end wall, and boxes beside the way, which is along x."""
    return [
        Quad.of([-5, -7, 0], [45, 0, 0], [0, 14, 0], 1),
        Quad.of([-5, 7, 0], [45, 0, 0], [0, 0, 9], 2),
        Quad.of([-5, -7, 0], [45, 0, 0], [0, 0, 9], 3),
        Quad.of([40, -7, 0], [0, 14, 0], [0, 0, 9], 4),
        *box(8, 3, 1.5, 2, 10),
        *box(16, -5, 2, 3, 20),
        *box(22, 3.5, 2.5, 2, 30),
    ]


def poses(count: int = 9, spacing: float = 1.2) -> F64:
    """(P, 4, 4) camera to world, along the street, swaying and looking half to the left."""
    found = np.tile(np.eye(4), (count, 1, 1))
    for i in range(count):
        yaw = np.radians(20 + 6 * np.sin(i))
        ahead = np.array([np.cos(yaw), np.sin(yaw), -0.05])
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        found[i, :3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
        found[i, :3, 3] = [spacing * i, 0.8 * np.sin(0.7 * i) - 1, 1.8 + 0.1 * np.cos(i)]
    return found


def render(quads: list[Quad], pose: F64, camera: Camera = CAMERA) -> U8:
    """Grey photo (H, W)."""
    rays = pixel_rays(camera).reshape(-1, 3).astype(np.float64) @ pose[:3, :3].T
    nearest, grey = np.full(len(rays), np.inf), np.full(len(rays), 200, np.uint8)
    for quad in quads:
        normal = np.cross(quad.u, quad.v)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (normal @ (quad.corner - pose[:3, 3])) / (rays @ normal)
        hit = pose[:3, 3] + depth[:, None] * rays - quad.corner
        a, b = hit @ quad.u / (quad.u @ quad.u), hit @ quad.v / (quad.v @ quad.v)
        seen = (depth > 0.1) & (depth < nearest) & (a >= 0) & (a < 1) & (b >= 0) & (b < 1)
        h, w = quad.texture.shape
        grey[seen] = quad.texture[(b[seen] * h).astype(int), (a[seen] * w).astype(int)]
        nearest[seen] = depth[seen]
    return cv2.GaussianBlur(grey.reshape(camera.height, camera.width), (0, 0), 0.7)


def cloud(quads: list[Quad], frame: Frame, spacing: float = 0.1) -> PointCloud:
    """Points on all planes, with the texture as intensity; the street's origin is that of the frame."""
    random = np.random.default_rng(0)
    points, grey = [], []
    for quad in quads:
        count = int(np.linalg.norm(np.cross(quad.u, quad.v)) / spacing**2)
        ab = random.uniform(size=(count, 2))
        points.append(quad.corner + ab[:, :1] * quad.u + ab[:, 1:] * quad.v)
        h, w = quad.texture.shape
        grey.append(quad.texture[(ab[:, 1] * h).astype(int), (ab[:, 0] * w).astype(int)])
    order = random.permutation(sum(map(len, points)))
    xyz, values = np.concatenate(points)[order], np.concatenate(grey)[order]
    return PointCloud(frame, xyz.astype(np.float32), intensity=values.astype(np.uint16) * 200)


def write(folder: Path, frame: Frame, count: int = 9, camera: Camera = CAMERA) -> F64:
    """Write `photos/00.jpg` ... and `cloud.laz`; returns the poses (P, 4, 4), camera to the local frame."""
    quads, T = street(), poses(count)
    for i, pose in enumerate(T):
        write_photo(folder / "photos" / f"{i:02d}.jpg", quads, pose, camera)
    las.write(folder / "cloud.laz", cloud(quads, frame))
    return T


def write_photo(path: Path, quads: list[Quad], pose: F64, camera: Camera = CAMERA) -> None:
    """Write a photo as JPEG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), render(quads, pose, camera), [cv2.IMWRITE_JPEG_QUALITY, 95])
