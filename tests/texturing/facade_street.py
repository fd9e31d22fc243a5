"""A street between facades that the scan reached only up to 3 m, with another across its far end, and a drive in it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera.depth_map import depth_map, scene
from scan2sim.pipeline.camera.renderer import Body, Image, Renderer, look_at, pinhole
from scan2sim.pipeline.core.classes import PHOTO_CLASSES
from scan2sim.pipeline.core.types import F64, Mesh, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.photo_cache import Exposures
from tests.texturing.corner import grid, join

SKY = (110, 160, 230)
CAMERA = pinhole(360, 180, field=80)
NUMBER, HELD_OUT, FAR_M, SIDE_M, SCANNED_M = 7, 3, 60.0, 12.0, 3.0


def painted(mesh: Mesh, seed: int, base: tuple[int, int, int]) -> Body:
    """The mesh with random colours, a different one for each pair of triangles."""
    shade = np.random.default_rng(seed).uniform(0.4, 1.3, len(mesh) // 2)
    return Body(mesh, colour=np.clip(np.outer(np.tile(shade, 2), base), 0, 255).astype(np.uint8))


def wall(y: float, low: float, high: float, cells: int) -> Mesh:
    """A wall along the street that faces its middle."""
    up, along = (0, 0, high - low), (FAR_M + 10, 0, 0)
    return join(grid((-10, y, low), up, along, cells) if y < 0 else grid((-10, y, low), along, up, cells))


GROUND = painted(join(grid((-10, -SIDE_M, 0), (45, 0, 0), (0, 2 * SIDE_M, 0), 40)), 0, (120, 120, 115))
SCANNED = [GROUND, *(painted(wall(y, 0, SCANNED_M, 12), 1, (170, 120, 90)) for y in (-SIDE_M, SIDE_M))]
UPPER = [painted(wall(y, SCANNED_M, 9, 24), 2, (180, 130, 100)) for y in (-SIDE_M, SIDE_M)]
END = painted(join(grid((FAR_M, -30, 0), (0, 0, 14), (0, 60, 0), 24)), 3, (90, 150, 110))


def pose_of(number: int) -> F64:
    return look_at((float(number), 0.3, 1.7), (float(number) + 10, 0, 1.9))


@cache
def photographed(number: int) -> Image:
    """The street from a pose, rendered once for all drives."""
    return Renderer([*SCANNED, *UPPER, END]).view(CAMERA, pose_of(number), background=SKY, samples=2)


@dataclass
class FacadeDrive:
    """A drive along the street, photographed.

    Attributes:
        folder: receives its files.
        vehicle: there is a vehicle ahead, at a constant position in the image.
        number: number of photos, one metre apart.
        noise: standard deviation of their noise, levels.
    """

    folder: Path
    vehicle: bool = False
    number: int = NUMBER
    noise: float = 0.0

    @cached_property
    def views(self) -> list[View]:
        """The photos, with their classes."""
        (self.folder / "labels").mkdir()
        found = []
        for i in range(self.number):
            pose, street = pose_of(i), photographed(i)
            rgb, labels = street.rgb.copy(), np.zeros((*street.hit.shape, len(PHOTO_CLASSES)), np.uint8)
            labels[..., PHOTO_CLASSES.index("building")] = 255 * street.hit
            labels[..., PHOTO_CLASSES.index("sky")] = 255 * ~street.hit
            if self.vehicle:
                rgb[75:94, 172:195] = (250, 10, 10)
                labels[75:94, 172:195] = 0
                labels[75:94, 172:195, PHOTO_CLASSES.index("vehicle")] = 255
            noise = np.random.default_rng(i).normal(0, self.noise, rgb.shape)
            image.write(self.folder / f"{i}.png", np.clip(rgb + noise, 0, 255).astype(np.uint8))
            np.save(self.folder / "labels" / f"{i}.npy", labels)
            found.append(View(str(i), CAMERA, pose, self.folder / f"{i}.png"))
        return found

    @cached_property
    def inputs(self) -> dict[str, Path]:
        """Inputs of steps: views (one of them held out), depth, labels, exposures and meshes."""
        inputs = {name: self.folder / name for name in ("views", "depth", "labels", "exposures")}
        views_io.save(inputs["views"], self.views, [i == HELD_OUT for i in range(self.number)])
        Exposures().save(inputs["exposures"])
        inputs["depth"].mkdir()
        occluders = scene([body.mesh for body in SCANNED])
        for i, view in enumerate(self.views):
            np.save(inputs["depth"] / f"{i}.npy", depth_map(view.camera, view.T_world_cam, occluders).range)
        for i, body in enumerate(SCANNED):
            body.mesh.save(self.folder / f"mesh{i}.npz")
            inputs[f"mesh.{i}"] = self.folder / f"mesh{i}.npz"
        return inputs
