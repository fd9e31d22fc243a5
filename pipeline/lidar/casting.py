"""Casting of the rays of a sweep through meshes, from the scanner towards each return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.types import F32, F64, Bools, Mesh


@dataclass(frozen=True)
class Simulated:
    """What a scanner finds in the world along the rays of N recorded returns.

    One ray per return, or a beam if its divergence is known: files of sweeps don't name the sensor.

    Attributes:
        recorded: (N,) recorded range, metres.
        range: (N,) range of the first surface along the ray, metres; inf without one.
        surface: (N,) index of the mesh that was hit, -1 without one.
        apart: (N,) distance of the return to the nearest surface in any direction, metres; inf without meshes.
        directions: (N, 3) unit vectors from the scanner to the return, local axes.
    """

    recorded: F32
    range: F32
    surface: npt.NDArray[np.int16]
    apart: F32
    directions: F64

    def take(self, index: Bools) -> Simulated:
        """The rays that `index` selects."""
        return Simulated(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    @staticmethod
    def join(parts: Sequence[Simulated]) -> Simulated:
        """The rays of all parts, of which there is at least one."""
        return Simulated(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Simulated)})


BEAM_RAYS = 6
"""Rays of a beam around its central one, at two thirds of its radius: each of all seven has an equal share of it."""
BEAM_DEPTH_M = 0.3
"""Distance between hits of a beam that give one return: the resolution of a pulse."""


class Scanner:
    """A scanner in a world of meshes.

    Args:
        scene: Open3D's `RaycastingScene` of the meshes.
        surfaces: index of the surface that each geometry of the scene belongs to, in order of their ids.
        divergence_rad: full angle of the scanner's beams; 0: rays without extent.
    """

    def __init__(self, scene: Any, surfaces: Sequence[int], divergence_rad: float = 0.0) -> None:
        self._scene, self._surfaces = scene, np.array([*surfaces, -1], np.int16)
        self._divergence = divergence_rad

    @classmethod
    def of(cls, meshes: Sequence[Mesh], divergence_rad: float = 0.0) -> Scanner:
        """A scanner in a world of meshes, whose indices are the surfaces."""
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        shown = [i for i, mesh in enumerate(meshes) if len(mesh)]
        for i in shown:
            vertices, faces = meshes[i].vertices, meshes[i].faces.astype(np.uint32)
            scene.add_triangles(np.ascontiguousarray(vertices), np.ascontiguousarray(faces))
        return cls(scene, shown, divergence_rad)

    def scan(self, origins: F64, returns: npt.NDArray[np.floating]) -> Simulated:
        """Cast a ray from `origins` (N, 3) towards each of the recorded `returns` (N, 3), local metres."""
        way = np.asarray(returns, np.float64) - origins
        recorded = np.linalg.norm(way, axis=1)
        directions = way / np.maximum(recorded, 1e-9)[:, None]
        distance, surface = self.cast_beams(origins, directions) if self._divergence else self.cast(origins, directions)
        apart = np.full(len(way), np.inf, np.float32)
        if len(self._surfaces) > 1 and len(way):
            apart = self._scene.compute_distance(np.ascontiguousarray(returns, np.float32)).numpy()
        return Simulated(recorded.astype(np.float32), distance, surface, apart, directions)

    def cast(self, origins: F64, directions: F64) -> tuple[F32, npt.NDArray[np.int16]]:
        """Ranges (N,) in metres of the first surfaces along rays, inf without one, and their indices, -1 without one.

        Args:
            origins: (N, 3) local metres.
            directions: (N, 3) unit vectors.
        """
        distance, surface = np.full(len(origins), np.inf, np.float32), np.full(len(origins), -1, np.int16)
        if len(self._surfaces) > 1 and len(origins):
            hits = self._scene.cast_rays(np.concatenate([origins, directions], axis=1, dtype=np.float32))
            distance = hits["t_hit"].numpy()
            known = np.where(np.isfinite(distance), hits["geometry_ids"].numpy(), len(self._surfaces) - 1)
            surface = self._surfaces[known]
        return distance, surface

    def cast_beams(self, origins: F64, directions: F64) -> tuple[F32, npt.NDArray[np.int16]]:
        """As `cast`, for beams: the strongest return, from the surface that most of a beam's rays hit.

        Of two that are as strong, the nearer one. Its range is the mean over the rays.
        """
        helper = np.where(np.abs(directions[:, 2:]) < 0.9, [[0.0, 0, 1]], [[1.0, 0, 0]])
        u = np.cross(directions, helper)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        v = np.cross(directions, u)
        radius, turns = self._divergence / 3, 2 * np.pi * np.arange(BEAM_RAYS) / BEAM_RAYS
        beam = [directions, *(directions + radius * (np.cos(t) * u + np.sin(t) * v) for t in turns)]
        hits = [self.cast(origins, way / np.linalg.norm(way, axis=1, keepdims=True)) for way in beam]
        ranges = np.stack([distance for distance, _ in hits]).astype(np.float64)
        surfaces = np.stack([surface for _, surface in hits])
        known = np.where(np.isfinite(ranges), ranges, -np.inf)  # rays without a hit return nothing
        together = np.abs(known[:, None] - np.where(known < 0, np.inf, known)[None]) < BEAM_DEPTH_M
        count = together.sum(axis=1)
        best = np.lexsort((ranges, -count), axis=0)[0]
        index = np.arange(len(origins))
        chosen = together[best, :, index].T
        total = np.where(chosen, ranges, 0).sum(axis=0)
        strength = count[best, index]
        distance = np.where(strength > 0, total / np.maximum(strength, 1), np.inf).astype(np.float32)
        return distance, np.where(strength > 0, surfaces[best, index], -1).astype(np.int16)
