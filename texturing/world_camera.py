"""A camera in a finished world: colour as photographs show it, depth, classes and instances, without a simulator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import get_args
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.camera.renderer import SKY_RGB, Body, Image, Renderer, placed
from scan2sim.pipeline.core.classes import CODE, CODE_OF_SURFACE
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.splats import XYZ, SplatLayer, Splats
from scan2sim.pipeline.core.types import F32, F64, I32, U8, Bools, Camera, CameraModel, Colour
from scan2sim.pipeline.io.worlds.instances import Instance, TileInstances, box_ids, instances_of
from scan2sim.pipeline.io.worlds.scene import BACKDROP, EXPORT_AGAIN, Scene, SceneTile
from scan2sim.texturing.splats.background import Background
from scan2sim.texturing.splats.view import SplatRenderer

FARTHEST_M = 300.0
"""Default distance beyond which tiles aren't drawn."""
IN_FRONT_M = 0.3
"""Distance from the surfaces from which on splats in a vehicle's box are the vehicle."""
BLACK = np.zeros((1, 2, 3), np.float32)
"""Background of splats over which another one is laid."""
BLEND_M = 10.0
"""Distance over which the background changes from a tile's to the next one's."""


@dataclass(frozen=True)
class CameraImage:
    """What a camera sees; arrays are (H, W).

    Attributes:
        rgb: (H, W, 3) uint8.
        range: metres along the ray to the first surface; where there is none, and where parked vehicles are in front
            that only splats show, to the splats, or inf.
        code: uint8 LAS code of the first surface, or of such a vehicle, 0 where there is none.
        instance: int32 id of what is seen (`WorldCamera.instances`), 0 where it has none.
    """

    rgb: U8
    range: F32
    code: U8
    instance: I32

    def depth(self, camera: Camera) -> F32:
        """(H, W) metres along the optical axis, as depth cameras give it; inf where there is nothing.

        It is negative behind a panorama's camera: use `range` there.
        """
        from scan2sim.pipeline.camera.models import pixel_rays

        return np.asarray(self.range * pixel_rays(camera)[..., 2], np.float32)


class WorldCamera:
    """Renders a world: splats where tiles have some, their textured surfaces before their backdrop elsewhere."""

    def __init__(self, scene: Scene, *, farthest: float = FARTHEST_M) -> None:
        """`farthest`: distance in metres beyond which tiles aren't drawn; the nearest one always is."""
        self._scene, self._farthest = scene, farthest
        self._layout = _Layout.of(scene.tiles)
        self._near: list[int] = []
        self._nearest = -1
        self._layers: dict[int, SplatLayer | None] = {}
        self._surfaces: _Surfaces
        self._splats: SplatRenderer | None = None
        self._backgrounds: dict[int, Background] = {}
        self._behind: Renderer | None = None
        self._instances: dict[int, TileInstances] = {}

    @property
    def instances(self) -> dict[int, Instance]:
        """Instances of the tiles that have been drawn so far, by id; ids don't depend on which these are."""
        tables = (self._instances[k].table for k in sorted(self._instances))
        return {one.id: one for table in tables for one in table}

    def render(self, T_world_cam: F64, camera: Camera, *, samples: int = 2) -> CameraImage:
        """Render a view.

        Args:
            T_world_cam: (4, 4) pose in world metres; camera axes x right, y down, z ahead.
            camera: any perspective model.
            samples: rays per pixel along each axis, of surfaces.

        Raises:
            SettingError: `T_world_cam` is no pose, or the camera has no focal length or an unknown model.
            InputError: the surfaces or the splats of a tile are missing or damaged.
        """
        T_world_cam = _pose(T_world_cam)
        _check_lens(camera)
        self._load(T_world_cam[:3, 3])
        seen = self._surfaces.view(camera, T_world_cam, samples=samples if self._surfaces.are_shown else 1)
        code, instance = self._surfaces.codes(seen), self._surfaces.instances(seen)
        if self._splats is None:
            rgb = self._before_backdrop(seen.rgb, seen.range, camera, T_world_cam, samples)
            return CameraImage(rgb, seen.range, code, instance)
        drawn = self._splats.view(camera, T_world_cam)
        rgb, shown = drawn.rgb, self._surfaces.shown(seen)
        if self._layers[self._nearest] is None:
            sky = np.broadcast_to(np.asarray(self._scene.sky or SKY_RGB, np.uint8), rgb.shape)
            behind = self._before_backdrop(sky, np.full(shown.shape, np.inf), camera, T_world_cam, samples)
            rgb = np.clip(np.rint(rgb + behind * (1 - drawn.cover[..., None])), 0, 255).astype(np.uint8)
        in_front = shown & (seen.range < drawn.range)
        rgb = np.where(in_front[..., None], seen.rgb, rgb)
        distance = np.where(seen.hit, seen.range, drawn.range)
        vehicle = self._vehicles(drawn.range, seen.range, camera, T_world_cam)
        is_vehicle = (vehicle > 0) & ~in_front
        return CameraImage(
            rgb,
            np.where(is_vehicle, drawn.range, distance),
            np.where(is_vehicle, np.uint8(CODE["vehicle"]), code),
            np.where(is_vehicle, vehicle, instance),
        )

    def colours(self, T_world_cam: F64, camera: Camera, *, samples: int = 2) -> U8:
        """Colours (H, W, 3) of a view, as `render` gives them; faster where all tiles have splats."""
        T_world_cam = _pose(T_world_cam)
        _check_lens(camera)
        self._load(T_world_cam[:3, 3])
        if self._splats is None or self._surfaces.are_shown:
            return self.render(T_world_cam, camera, samples=samples).rgb
        return self._splats.view(camera, T_world_cam).rgb

    def _vehicles(self, shown: F32, surfaces: F32, camera: Camera, T_world_cam: F64) -> I32:
        """Ids (H, W) of the vehicles in whose boxes splats are shown before the surfaces, by the ranges of both."""
        from scan2sim.pipeline.camera.models import pixel_rays

        found = np.zeros(shown.shape, np.int32)
        boxes = [box for k in self._near for box in self._instances[k].boxes]
        chosen = np.isfinite(shown) & (shown < surfaces - IN_FRONT_M)
        if boxes and chosen.any():
            rays = pixel_rays(camera)[chosen].astype(np.float64) @ T_world_cam[:3, :3].T
            found[chosen] = box_ids(T_world_cam[:3, 3] + rays * shown[chosen, None], boxes)
        return found

    def _before_backdrop(self, rgb: U8, distance: F32, camera: Camera, T_world_cam: F64, samples: int) -> U8:
        """Colours (H, W, 3) of a view with ranges (H, W), and those of backdrop and sky dome where these are nearer."""
        if self._behind is None:
            return rgb
        behind = self._behind.view(camera, T_world_cam, samples=samples)
        return np.where((behind.range < distance)[..., None], behind.rgb, rgb)

    def _load(self, position: F64) -> None:
        """Prepare the tiles near a position, and the background there, unless they are prepared."""
        order, distance = self._layout.by_distance(position)
        near = sorted(order[: max(1, int(np.count_nonzero(distance <= self._farthest)))])
        if near != self._near:
            self._near = []  # if a file of a tile can't be read, the next view prepares its tiles again
            self._layers = {k: self._layers[k] if k in self._layers else _placed(self._scene.tiles[k]) for k in near}
            tiles, shown = [self._scene.tiles[k] for k in near], [self._layers[k] is None for k in near]
            bodies = [_bodies(tile) for tile in tiles]
            for k, own in zip(near, bodies, strict=True):
                if k not in self._instances:
                    meshes = {group: (body.mesh, codes) for group, (body, codes) in own.items()}
                    self._instances[k] = instances_of(self._scene.tiles[k], k, meshes)
            self._surfaces = _Surfaces(bodies, [self._instances[k] for k in near], shown, self._scene.sky)
            plain = [tile for tile, is_shown in zip(tiles, shown, strict=True) if is_shown]
            self._behind = _backdrops([*plain, *([self._scene.dome] if self._scene.dome else [])], self._scene.sky)
            layers = {k: layer for k, layer in self._layers.items() if layer is not None}
            self._splats = _splats(list(layers.values()))
            self._backgrounds = {k: Background(layer.background) for k, layer in layers.items()}
        self._near, self._nearest = near, order[0]
        if self._splats is not None:
            shares = self._layout.shares(position, list(self._backgrounds))
            black = self._layers[self._nearest] is None
            self._splats.behind = (
                [(Background(BLACK), 1.0)] if black else [(self._backgrounds[k], share) for k, share in shares.items()]
            )


def _pose(T_world_cam: npt.ArrayLike) -> F64:
    """The pose (4, 4) as an array.

    Raises:
        SettingError: it has another shape, or contains NaN or infinity.
    """
    T = np.asarray(T_world_cam, np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        cause = f"is no pose: shape {T.shape}" + ("" if T.shape != (4, 4) else ", with NaN or infinity")
        raise SettingError("T_world_cam", cause, "Give a finite matrix (4, 4), camera to world")
    return T


def _check_lens(camera: Camera) -> None:
    """Reject a camera that sees nothing.

    Raises:
        SettingError: its model is unknown, or it has no focal length or no pixels.
    """
    models = get_args(CameraModel)
    if camera.model not in models:
        raise SettingError("camera", f"has the unknown model {camera.model!r}", f"Use {', '.join(models)}")
    if min(camera.width, camera.height) < 1:
        raise SettingError("camera", f"has {camera.width} x {camera.height} pixels", "Give its size in pixels")
    if camera.model != "equirectangular" and not min(camera.fx, camera.fy) > 0:
        raise SettingError("camera", "has no focal length", "Give fx and fy in pixels, and cx and cy")


@dataclass(frozen=True)
class _Layout:
    """Horizontal bounding boxes of tiles in world metres: corners (T, 2)."""

    low: F64
    high: F64

    @classmethod
    def of(cls, tiles: tuple[SceneTile, ...]) -> _Layout:
        offset = np.array([tile.offset for tile in tiles])[:, :2]
        low, high = (np.array([getattr(tile, end) for tile in tiles])[:, :2] + offset for end in ("low", "high"))
        return cls(low, high)

    def by_distance(self, position: F64) -> tuple[list[int], F64]:
        """Tiles by their distance from a position, and their distances in metres (0 inside), in this order.

        Of several that contain it, the one comes first whose middle is nearest.
        """
        xy = position[:2]
        distance = np.linalg.norm(np.maximum(0, np.maximum(self.low - xy, xy - self.high)), axis=1)
        order = np.lexsort((np.linalg.norm((self.low + self.high) / 2 - xy, axis=1), distance))
        return order.tolist(), distance[order]

    def shares(self, position: F64, of: list[int]) -> dict[int, float]:
        """Shares of the backgrounds of some tiles at a position: from one to the next over `BLEND_M`; sum is 1."""
        xy = position[:2]
        past = np.maximum(self.low[of] - xy, xy - self.high[of])  # of each side, negative inside
        signed = np.linalg.norm(np.maximum(0, past), axis=1) + np.minimum(0, past.max(axis=1))
        weight = np.maximum(0, 1 - (signed - signed.min()) / BLEND_M)
        weight = weight / weight.sum()
        return {k: share for k, share in zip(of, weight.tolist(), strict=True) if share > 0}


_Bodies = dict[str, tuple[Body, U8]]
"""Textured surfaces of a tile in world metres, and the LAS codes of their faces, by group."""


@contextmanager
def _readable(folder: Path) -> Iterator[None]:
    """Convert the errors of a file in a folder of the world that is missing or damaged.

    Raises:
        InputError: names the folder.
    """
    try:
        yield
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise InputError(folder, f"can't be read ({error})", EXPORT_AGAIN) from error


def _bodies(tile: SceneTile) -> _Bodies:
    found: _Bodies = {}
    for group in tile.groups:
        with _readable(tile.folder / group):
            body = placed(tile.folder / group, tile.offset)
        own, codes = tile.codes.get(group, CODE_OF_SURFACE[group]), body.mesh.classification
        whole = np.full(len(body.mesh), own, np.uint8)
        found[group] = body, whole if codes is None else np.where(codes == 0, whole, codes)
    return found


class _Surfaces:
    """Textured surfaces of tiles: distance, class and instance of all, colour of those without splats.

    Attributes:
        are_shown: whether any are seen, not only measured.
    """

    def __init__(
        self, tiles: list[_Bodies], instances: list[TileInstances], shown: list[bool], sky: Colour | None
    ) -> None:
        """`shown`: whether the colours of a tile's surfaces are seen; those of tiles with splats aren't."""
        self._codes = [codes for own in tiles for _, codes in own.values()]
        self._ids = [known.faces[group] for own, known in zip(tiles, instances, strict=True) for group in own]
        is_shown = [its_colours for own, its_colours in zip(tiles, shown, strict=True) for _ in own]
        bodies = [body for own in tiles for body, _ in own.values()]
        self._renderer, self._is_shown, self.are_shown = Renderer(bodies, sky), np.array(is_shown, bool), any(shown)

    def view(self, camera: Camera, T_world_cam: F64, *, samples: int) -> Image:
        """The view of a camera."""
        return self._renderer.view(camera, T_world_cam, samples=samples)

    def shown(self, seen: Image) -> Bools:
        """(H, W) whether a pixel's first surface is that of a tile without splats."""
        return seen.hit & self._is_shown[seen.body]

    def codes(self, seen: Image) -> U8:
        """(H, W) LAS code of each pixel's first surface, 0 where there is none."""
        found = np.zeros(seen.hit.shape, np.uint8)
        for body, codes in enumerate(self._codes):
            at = seen.hit & (seen.body == body)
            found[at] = codes[seen.face[at]]
        return found

    def instances(self, seen: Image) -> I32:
        """(H, W) id of each pixel's first surface, 0 where it has none."""
        found = np.zeros(seen.hit.shape, np.int32)
        for body, ids in enumerate(self._ids):
            at = seen.hit & (seen.body == body)
            found[at] = ids[seen.face[at]]
        return found


def _backdrops(tiles: list[SceneTile], sky: Colour | None) -> Renderer | None:
    """Backdrops of tiles and of the dome; None: they have none."""
    bodies = [placed(tile.folder / BACKDROP, tile.offset) for tile in tiles if (tile.folder / BACKDROP).is_dir()]
    return Renderer(bodies, sky) if bodies else None


def _placed(tile: SceneTile) -> SplatLayer | None:
    """The splats of a tile in world metres; None: it has none."""
    with _readable(tile.folder):
        layer = tile.splats()
    if layer is None:
        return None
    layer.splats.parameters[:, XYZ] += np.asarray(tile.offset, np.float32)
    return layer


def _splats(layers: list[SplatLayer]) -> SplatRenderer | None:
    """The splats of all tiles; None: there are none."""
    if not layers:
        return None
    parts = [layer.splats.parameters for layer in layers]
    return SplatRenderer(SplatLayer(Splats(parts[0] if len(parts) == 1 else np.concatenate(parts)), BLACK))
