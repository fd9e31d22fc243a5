"""A camera in a finished world: colour as photographs show it, depth and classes, without a simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.camera.renderer import Renderer, placed
from scan2sim.pipeline.core.classes import CODE_OF_SURFACE
from scan2sim.pipeline.core.splats import XYZ, SplatLayer, Splats
from scan2sim.pipeline.core.types import F32, F64, U8, Camera
from scan2sim.pipeline.io.worlds.scene import BACKDROP, Scene, SceneTile
from scan2sim.texturing.splats.view import SplatRenderer

FARTHEST_M = 300.0
"""Tiles farther from the camera than this aren't drawn."""


@dataclass(frozen=True)
class CameraImage:
    """What a camera sees; arrays are (H, W).

    Attributes:
        rgb: (H, W, 3) uint8.
        range: metres along the ray to the first surface; where there is none, to the splats, or inf.
        code: uint8 LAS code of the first surface, 0 where there is none.
    """

    rgb: U8
    range: F32
    code: U8

    def depth(self, camera: Camera) -> F32:
        """(H, W) metres along the optical axis, as depth cameras give it; inf where there is nothing.

        It is negative behind a panorama's camera: use `range` there.
        """
        from scan2sim.pipeline.camera.models import pixel_rays

        return np.asarray(self.range * pixel_rays(camera)[..., 2], np.float32)


class WorldCamera:
    """Renders a world: splats where it has some, otherwise its textured surfaces before their backdrop."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._near: tuple[str, ...] = ()
        self._surfaces: Renderer | None = None
        self._codes: list[U8] = []
        self._behind: Renderer | None = None
        self._splats: SplatRenderer | None = None

    def render(self, T_world_cam: F64, camera: Camera, *, samples: int = 2) -> CameraImage:
        """Render a view.

        Args:
            T_world_cam: (4, 4) pose in world metres; camera axes x right, y down, z ahead.
            camera: any model.
            samples: rays per pixel along each axis, of surfaces.
        """
        self._load(T_world_cam[:3, 3])
        assert self._surfaces is not None
        seen = self._surfaces.view(camera, T_world_cam, samples=samples)
        code = np.zeros(seen.hit.shape, np.uint8)
        for body, codes in enumerate(self._codes):
            at = seen.hit & (seen.body == body)
            code[at] = codes[seen.face[at]]
        if self._splats is not None:
            drawn = self._splats.view(camera, T_world_cam)
            return CameraImage(drawn.rgb, np.where(seen.hit, seen.range, drawn.range), code)
        rgb = seen.rgb
        if self._behind is not None:
            behind = self._behind.view(camera, T_world_cam, samples=samples)
            rgb = np.where((behind.range < seen.range)[..., None], behind.rgb, rgb)
        return CameraImage(np.asarray(rgb, np.uint8), seen.range, code)

    def _load(self, position: F64) -> None:
        """Prepare the tiles near a position, unless they are prepared."""
        near = [tile for tile in self._scene.tiles if _distance(tile, position) < FARTHEST_M] or [*self._scene.tiles]
        if tuple(tile.name for tile in near) == self._near:
            return
        self._near = tuple(tile.name for tile in near)
        bodies, self._codes = [], []
        for tile in near:
            for group in tile.groups:
                body = placed(tile.folder / group, tile.offset)
                bodies.append(body)
                codes = body.mesh.classification
                own = tile.codes.get(group, CODE_OF_SURFACE[group])
                self._codes.append(
                    np.full(len(body.mesh), own, np.uint8) if codes is None else np.where(codes == 0, own, codes)
                )
        self._surfaces = Renderer(bodies, self._scene.sky)
        backdrops = [placed(tile.folder / BACKDROP, tile.offset) for tile in near if (tile.folder / BACKDROP).is_dir()]
        self._behind = Renderer(backdrops, self._scene.sky) if backdrops else None
        self._splats = _splats(near, position)


def _splats(tiles: list[SceneTile], position: F64) -> SplatRenderer | None:
    """The splats of tiles in world metres, before the background of the nearest; None: they have none."""
    layers = [(tile, layer) for tile in tiles if (layer := tile.splats()) is not None]
    if not layers:
        return None
    parts = []
    for tile, layer in layers:
        parameters = layer.splats.parameters.copy()
        parameters[:, XYZ] += np.asarray(tile.offset, np.float32)
        parts.append(parameters)
    nearest = min(layers, key=lambda one: _distance(one[0], position))[1]
    return SplatRenderer(SplatLayer(Splats(np.concatenate(parts)), nearest.background))


def _distance(tile: SceneTile, position: F64) -> float:
    """Horizontal distance of a position from a tile's bounding box, metres."""
    low, high = (np.add(corner, tile.offset)[:2] for corner in (tile.low, tile.high))
    outside = np.maximum(0, np.maximum(low - position[:2], position[:2] - high))
    return float(np.linalg.norm(outside))
