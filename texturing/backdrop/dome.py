"""Sky dome: colours of all directions in which photos show sky; elsewhere, of what they show instead.

A tile that is built alone has its own. Domes of a survey's tiles would hide each other, so the survey's world has one:
the mean of theirs (`Mean`), at least ten times as large as the survey, so that directions to it hardly change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I32, U8, Bools, Mesh
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds.scene import BACKDROP, LAYERS_PAGE, SKY_PAGE, Scene
from scan2sim.texturing.backdrop.photos import FARTHEST_M, Photo, fill

WIDTH_PX, HEIGHT_PX = 2048, 512
LOWEST_DEG, HIGHEST_DEG = -25.0, 90.0
"""Elevations of the lowest and the highest row of the texture."""
RADIUS_M = 1.6 * FARTHEST_M
"""Radius: beyond all layers seen from any photo of a tile, within the usual far clipping distance of cameras."""
MIN_VOTES_SHARE = 0.3
"""Share of the photos of a direction that must show sky there: a white wall that passes isn't sky."""
SEGMENTS, RINGS = 48, 16
SKY, SCENERY = 2, 1
"""Levels of `Dome.shows`; 0: no photo shows that direction, or too few show sky there."""
DOME_FILE = "dome.npz"
SURVEY_RADII = 10.0
"""Radius of a survey's dome over the largest distance of its tiles from the middle: directions to a place on the dome
differ by asin(1 / 10), 6 degrees, between the middle and the farthest tile."""
FEATHER_PX, FEATHER_MIN = 64, 1 / 64
"""Texels (11 degrees) from the border of a tile's sky over which its weight in the mean of all tiles rises."""
MIN_TILES_SHARE = 0.1
"""Share of the tiles that know a direction that must show sky there, for it to be sky in the mean of all."""
SCENERY_HIGHEST_DEG = 3.0
"""Elevation above which a survey's dome is sky: trees and houses belong to the place that they were seen from."""
GAMMA = 2.2
"""Exponent from grey levels to linear colours."""
EXPOSURE_STEP_PX, EXPOSURE_ROUNDS = 16, 30
"""Spacing of the texels that exposures of tiles are compared at, and iterations."""


@dataclass(frozen=True)
class Dome:
    """What the photos of a tile show of the sky.

    Attributes:
        colour: (`HEIGHT_PX`, `WIDTH_PX`, 3) complete texture, by azimuth (column, from -180 degrees) and elevation
            (row, from the top).
        shows: (`HEIGHT_PX`, `WIDTH_PX`) uint8, `SKY`, `SCENERY` or 0.
    """

    colour: U8
    shows: U8

    def save(self, folder: Path) -> None:
        """Write it into a folder, as `DOME_FILE`."""
        np.savez_compressed(folder / DOME_FILE, colour=self.colour, shows=self.shows)

    @classmethod
    def load(cls, folder: Path) -> Dome:
        """Read what `save` wrote."""
        with np.load(folder / DOME_FILE) as saved:
            return cls(saved["colour"], saved["shows"])


def from_photos(photos: Sequence[Photo], kept: Sequence[F32]) -> Dome:
    """The dome of a tile.

    An overexposed channel of a photo is a lower bound: it counts as the mean of others if that is brighter. Directions
    in which all photos show something else get its mean colour. Those in which few show sky (`MIN_VOTES_SHARE`), and
    those that no photo shows, are filled smoothly: above the horizon from the sky, below it from what else photos show
    below it.

    Args:
        photos: photos with depth.
        kept: (H, W) for each of them, above 0 at pixels that are scenery, not a vehicle nearby.
    """
    import cv2

    from scan2sim.pipeline.camera.projection import pixels

    directions = _directions().reshape(-1, 3)
    count = len(directions)
    total, number, clipped, bound, other = (np.zeros((count, 3), np.float32) for _ in range(5))
    others, seen = np.zeros(count, np.float32), np.zeros(count, np.float32)
    for photo, scenery in zip(photos, kept, strict=True):
        uv, inside = pixels(photo.camera, photo.view.T_world_cam, photo.view.centre + directions * 1e5)
        index = np.flatnonzero(inside)
        column, row = np.clip(np.rint(uv[index]).astype(int), 0, np.array(photo.sky.shape[::-1]) - 1).T
        is_sky = cv2.erode(photo.sky.astype(np.uint8), np.ones((3, 3))) > 0
        is_scene = (~photo.hit & (scenery > 0) & ~photo.sky)[row, column]
        is_sky = is_sky[row, column]
        levels, over = photo.levels[row, column], photo.clipped[row, column] & is_sky[:, None]
        exact = is_sky[:, None] & ~over
        total[index] += np.where(exact, levels, 0)
        number[index] += exact
        clipped[index] += over
        bound[index] += np.where(over, levels, 0)
        other[index] += np.where(is_scene[:, None], levels, 0)
        others[index] += is_scene
        seen[index] += 1
    exact_mean, bound_mean = total / np.maximum(number, 1), bound / np.maximum(clipped, 1)
    colour = (total + clipped * np.maximum(exact_mean, bound_mean)) / np.maximum(number + clipped, 1)
    colour = np.clip(colour, 0, 255)
    votes = (number + clipped).max(axis=1)
    known, only_scene = votes > MIN_VOTES_SHARE * seen, (votes == 0) & (others > 0)
    known = known if known.any() else votes > 0
    scene = np.asarray(np.clip(other / np.maximum(others, 1)[:, None], 0, 255), np.float32)
    shows = np.where(known, SKY, np.where(only_scene, SCENERY, 0)).astype(np.uint8)
    return Dome(_completed(colour, known, scene, only_scene), shows.reshape(HEIGHT_PX, WIDTH_PX))


def _completed(colour: F32, known: Bools, scene: F32, only_scene: Bools) -> U8:
    """Texture of colours of the sky (N, 3) where `known` (N,), of scenery where `only_scene`, and filled elsewhere."""
    below = _directions().reshape(-1, 3)[:, 2] < 0
    smooth = _filled(colour, known) if known.any() else _filled(scene, only_scene)
    low = only_scene & below
    smooth = np.where(below[:, None], _filled(scene, low), smooth) if low.any() else smooth
    colour = np.where(known[:, None], colour, np.where(only_scene[:, None], scene, smooth))
    return np.clip(colour, 0, 255).reshape(HEIGHT_PX, WIDTH_PX, 3).astype(np.uint8)


@dataclass(frozen=True)
class Mean:
    """Mean of the domes of several tiles, in linear colours, with exposures equalized where two tiles show sky.

    Attributes:
        folders: of the tiles' domes (`Dome.save`).
    """

    folders: Sequence[Path]

    def gains(self) -> F64:
        """(T, 3) factors of the linear colours of each tile; their geometric mean is 1.

        They make tiles agree in the least-squares sense at texels that both show as sky, by alternating between the
        mean sky and the factors of all tiles.
        """
        sparse = (slice(EXPOSURE_STEP_PX // 2, None, EXPOSURE_STEP_PX),) * 2
        domes = (Dome.load(folder) for folder in self.folders)
        small = [(dome.colour[sparse].copy(), dome.shows[sparse].copy()) for dome in domes]
        levels = np.log(_linear(np.array([colour for colour, _ in small])) + 1e-3).astype(np.float64)
        weight = np.array([shows == SKY for _, shows in small])[..., None].astype(np.float64)
        logarithm = np.zeros((len(small), 1, 1, 3))
        for _ in range(EXPOSURE_ROUNDS):
            mean = (weight * (levels + logarithm)).sum(axis=0) / np.maximum(weight.sum(axis=0), 1)
            apart = (weight * (mean - levels)).sum(axis=(1, 2), keepdims=True)
            logarithm = apart / np.maximum(weight.sum(axis=(1, 2), keepdims=True), 1)
            logarithm -= logarithm.mean(axis=0)
        return np.asarray(np.exp(logarithm[:, 0, 0]), np.float64)

    def texture(self) -> U8:
        """Texture (`HEIGHT_PX`, `WIDTH_PX`, 3) of the dome of all tiles."""
        sky, scene = (np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.float32) for _ in range(2))
        skies, scenes, tiles, sky_tiles = (np.zeros((HEIGHT_PX, WIDTH_PX, 1), np.float32) for _ in range(4))
        for folder, gain in zip(self.folders, self.gains(), strict=True):
            dome = Dome.load(folder)
            linear = _linear(dome.colour) * gain.astype(np.float32)
            weight, is_scene = _feather(dome.shows == SKY)[..., None], (dome.shows == SCENERY)[..., None]
            sky, skies = sky + weight * linear, skies + weight
            scene, scenes = scene + is_scene * linear, scenes + is_scene
            tiles += (dome.shows > 0)[..., None]
            sky_tiles += (dome.shows == SKY)[..., None]
        known = (sky_tiles > MIN_TILES_SHARE * tiles).ravel()
        is_low = _directions()[..., 2].ravel() < np.sin(np.radians(SCENERY_HIGHEST_DEG))
        only_scene = ~known & (scenes > 0).ravel() & is_low
        colour, other = (
            _levels(np.asarray(total / np.maximum(count, 1e-6), np.float32)).reshape(-1, 3)
            for total, count in ((sky, skies), (scene, scenes))
        )
        return _completed(colour, known, other, only_scene)


def _linear(levels: U8) -> F32:
    return np.asarray((np.arange(256) / 255) ** GAMMA, np.float32)[levels]


def _levels(linear: F32) -> F32:
    return np.asarray(255 * np.minimum(linear, 1) ** np.float32(1 / GAMMA), np.float32)


def _feather(known: Bools) -> F32:
    """(H, W) weight: 1 at `FEATHER_PX` texels inside the mask, `FEATHER_MIN` at its border, 0 outside."""
    import cv2

    around = np.pad(known.astype(np.uint8), ((0, 0), (FEATHER_PX, FEATHER_PX)), mode="wrap")
    inside = cv2.distanceTransform(around, cv2.DIST_L2, 3)[:, FEATHER_PX:-FEATHER_PX] / FEATHER_PX
    return np.where(known, np.clip(inside, FEATHER_MIN, 1), 0).astype(np.float32)


def of_survey(scene: Scene, folder: Path) -> None:
    """Write the dome of a survey's world into `folder`, a textured mesh in metres from the scene's origin.

    Nothing is written if no tile has a dome to add, because it is built alone and has its own, or has no photos.
    """
    tiles = [tile for tile in scene.tiles if (tile.folder / BACKDROP / DOME_FILE).is_file()]
    if not tiles:
        return
    folder.mkdir(parents=True)
    texture = Mean([tile.folder / BACKDROP for tile in tiles]).texture()
    for number, colours in ((LAYERS_PAGE, texture[:1, :1]), (SKY_PAGE, texture)):
        image.write(folder / f"page_{number}.png", colours)
    low = np.min([np.add(tile.low, tile.offset) for tile in scene.tiles], axis=0)
    high = np.max([np.add(tile.high, tile.offset) for tile in scene.tiles], axis=0)
    heights = [view.centre[2] + tile.offset[2] for tile in tiles for view in tile.views()]
    centre = (low + high) / 2
    centre[2] = np.mean(heights) if heights else centre[2]
    vertices, faces, uv = mesh(centre, RADIUS_M + SURVEY_RADII * float(np.hypot(*(high - low)[:2])) / 2)
    page = np.full(len(faces), SKY_PAGE, np.int16)
    Mesh(scene.frame, vertices, faces, uv=uv, page=page).save(folder / "mesh.npz")


def _filled(colour: F32, known: Bools) -> F32:
    """Colours (N, 3) of all directions, filled around the horizon."""
    image, mask = colour.reshape(HEIGHT_PX, WIDTH_PX, 3), known.reshape(HEIGHT_PX, WIDTH_PX)
    around = fill(np.tile(image, (1, 3, 1)), np.tile(mask, (1, 3)))
    return around[:, WIDTH_PX : 2 * WIDTH_PX].reshape(-1, 3)


def _directions() -> F64:
    """(`HEIGHT_PX`, `WIDTH_PX`, 3) unit direction of each texel."""
    azimuth = (np.arange(WIDTH_PX) + 0.5) / WIDTH_PX * 2 * np.pi - np.pi
    elevation = np.radians(HIGHEST_DEG - (np.arange(HEIGHT_PX) + 0.5) / HEIGHT_PX * (HIGHEST_DEG - LOWEST_DEG))
    azimuth, elevation = np.meshgrid(azimuth, elevation)
    return _unit(azimuth, elevation)


def _unit(azimuth: F64, elevation: F64) -> F64:
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def sample(dome: U8, directions: F64) -> F32:
    """Colours (H, W, 3) of a dome's texture in directions (H, W, 3), bilinear."""
    import cv2

    azimuth = np.arctan2(directions[..., 1], directions[..., 0])
    elevation = np.degrees(np.arcsin(np.clip(directions[..., 2], -1, 1)))
    column = (azimuth + np.pi) / (2 * np.pi) * WIDTH_PX - 0.5
    row = np.clip((HIGHEST_DEG - elevation) / (HIGHEST_DEG - LOWEST_DEG) * HEIGHT_PX - 0.5, 0, HEIGHT_PX - 1)
    maps = column.astype(np.float32), row.astype(np.float32)
    return np.asarray(cv2.remap(dome.astype(np.float32), *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))


def mesh(centre: F64, radius: float = RADIUS_M) -> tuple[F32, I32, F32]:
    """Vertices (V, 3), faces (F, 3) seen from inside, and texture coordinates (F, 3, 2) of the dome around a point."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, SEGMENTS + 1),
        np.radians(np.append(np.linspace(HIGHEST_DEG, LOWEST_DEG, RINGS), -90.0)),
    )
    vertices = centre + radius * _unit(azimuth, elevation)
    u = (azimuth + np.pi) / (2 * np.pi)
    v = np.clip((np.degrees(elevation) - LOWEST_DEG) / (HIGHEST_DEG - LOWEST_DEG), 0, 1)
    row, column = (a.ravel() for a in np.meshgrid(np.arange(RINGS), np.arange(SEGMENTS), indexing="ij"))
    first = row * (SEGMENTS + 1) + column
    below = first + SEGMENTS + 1
    upper, lower = np.stack([first, first + 1, below], axis=1), np.stack([first + 1, below + 1, below], axis=1)
    faces = np.concatenate([upper[row > 0], lower[row < RINGS - 1]])  # those at the zenith and the nadir have no area
    uv = np.stack([u.ravel(), v.ravel()], axis=1)[faces]
    return vertices.reshape(-1, 3).astype(np.float32), faces.astype(np.int32), uv.astype(np.float32)
