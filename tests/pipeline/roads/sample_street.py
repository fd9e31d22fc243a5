"""A synthetic road: ground points with classes, a texture with lane markings, a driven path."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.types import F64, Frame, Mesh, PointCloud, Trajectory

UTM = Frame("EPSG:32632", (690_000.0, 5_335_000.0, 500.0))
PIXEL = 0.03
SLOPE, FALL, KERB = 0.03, -0.02, 0.12


@dataclass(frozen=True)
class Street:
    """A road along an arc through the origin, which begins eastwards.

    Attributes:
        radius: metres, to the left.
        length: metres, as much to either side of the origin.
        lane: from the axis to the edge lines; edge: to the kerbs.
    """

    radius: float = 150.0
    length: float = 56.0
    lane: float = 3.2
    edge: float = 3.6
    frame: Frame = UTM

    def place(self, s: np.ndarray, t: np.ndarray | float) -> np.ndarray:
        angle = np.asarray(s) / self.radius
        return np.column_stack([(self.radius - t) * np.sin(angle), self.radius - (self.radius - t) * np.cos(angle)])

    def locate(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = xy[:, 0], self.radius - xy[:, 1]
        return np.arctan2(x, y) * self.radius, self.radius - np.hypot(x, y)

    def height(self, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        return SLOPE * s + FALL * np.abs(t) + KERB * (np.abs(t) > self.edge)

    def cloud(self, density: float = 150.0, seed: int = 0) -> PointCloud:
        rng = np.random.default_rng(seed)
        n = int(density * self.length * 16)
        s, t = rng.uniform(-self.length / 2, self.length / 2, n), rng.uniform(-8, 8, n)
        z = self.height(s, t) + rng.normal(0, 0.01, n)
        xyz = np.column_stack([self.place(s, t), z]).astype(np.float32)
        code = np.where(np.abs(t) < self.edge, CODE["road"], CODE["sidewalk"]).astype(np.uint8)
        return PointCloud(self.frame, xyz, classification=code)

    def path(self) -> Trajectory:
        s = np.arange(-self.length / 2 + 1, self.length / 2 - 1, 0.7)
        xyz: F64 = np.asarray(np.column_stack([self.place(s, -1.6), SLOPE * s + 2.0]), np.float64)
        return Trajectory(np.arange(len(s), dtype=np.float64) / 10, xyz)

    def painted(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Whether there is paint: solid edge lines, and a broken centre line, 3 m of 6 m."""
        s, t = self.locate(np.column_stack([x.ravel(), y.ravel()]))
        solid = np.abs(np.abs(t) - self.lane) < 0.06
        paint = (solid | ((np.abs(t) < 0.06) & (s % 6 < 3))) & (np.abs(s) < self.length / 2)
        return paint.reshape(x.shape)

    def textured(self, folder: Path, paint: bool = True) -> Path:
        """A flat textured mesh, as the step `texture` writes it."""
        rng = np.random.default_rng(3)
        folder.mkdir(parents=True)
        corners = self.place(np.linspace(-self.length / 2, self.length / 2, 50), np.repeat([-8.0, 8.0], 25))
        (x0, y0), (x1, y1) = np.floor(corners.min(axis=0)) - 1, np.ceil(corners.max(axis=0)) + 1
        vertices = np.array([(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)], np.float32)
        uv = np.array([[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]], np.float32)
        faces = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
        Mesh(self.frame, vertices, faces, uv=uv, page=np.zeros(2, np.int16)).save(folder / "mesh.npz")
        columns, rows = np.arange(x0, x1, PIXEL) + PIXEL / 2, np.arange(y1, y0, -PIXEL) - PIXEL / 2
        light = rng.normal(105, 12, (len(rows), len(columns)))
        if paint:
            light[self.painted(*np.meshgrid(columns, rows))] = 200
        cv2.imwrite(str(folder / "page_0.png"), light.clip(0, 255).astype(np.uint8))
        cv2.imwrite(str(folder / "page_0_seen.png"), np.full(light.shape, 255, np.uint8))
        return folder

    def inputs(self, folder: Path, *, paint: bool = True, cloud: PointCloud | None = None) -> dict[str, Path]:
        """Inputs of the step `roads`."""
        textured = self.textured(folder / "textured", paint)
        (self.cloud() if cloud is None else cloud).save(folder / "cloud.npz")
        self.path().save(folder / "path.npz")
        return {"cloud": folder / "cloud.npz", "path": folder / "path.npz", "textured": textured}
