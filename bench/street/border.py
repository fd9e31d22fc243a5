"""Splats across the border of two tiles of a survey: a street that is cut in two, each half trained on its own photos.

`border_grey_levels` is the jump that a camera sees when it crosses the border (`scan2sim.camera`): the largest mean
difference, in grey levels, between a frame and the next one, `FRAME_M` further, within `NEAR_M` of the border, less the
median of these differences, which is motion. `background_grey_levels` is what it would be if the background changed at
once. `border_step_grey_levels` is the step within a picture: by how much one tile's splats are brighter than the
other's within `NEAR_M` of the border, relative to the photos that show both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bench.street import score
from bench.street.splats import camera_of
from bench.street.world import Photo, photos
from scan2sim.pipeline.camera.models import pixel_rays
from scan2sim.pipeline.core.splats import XYZ, SplatLayer, Splats
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.io.worlds.scene import SceneTile, read_scene
from scan2sim.texturing.splats.view import SplatRenderer
from scan2sim.texturing.world_camera import WorldCamera

LENGTH_M, PHOTO_DISTANCE_M = 14.0, 10.0
"""Length of the tiles, and distance beyond a border from which photos are used (40 m of a tile of 100 m)."""
SETTINGS = ("splats.when=auto", "voxel.size=0.2", "unwrap.texel=0.04", "pictures.width=640")
"""Settings of the survey: meshes are coarser than by default, splats are not."""
NEAR_M = 5.0
FRAME_M, FRAME_SCALE = 0.05, 0.25
"""Distance between frames, and their size relative to the photos'."""
MIN_SHARE = 0.02
"""Share of a photo that each tile must cover near the border."""


def build(corridor: Path, tiles: Path, made: Path, scan2sim: Callable[..., object]) -> None:
    """Cut a street into `tiles` and build the survey's world in `made`, with a function that runs the command."""
    if not (tiles / "survey.toml").is_file():
        scan2sim("tile", corridor, "--length", LENGTH_M, "--photo-distance", PHOTO_DISTANCE_M, "--out", tiles)
    scan2sim("survey", tiles, "--out", made, *(part for one in SETTINGS for part in ("--set", one)))


def metrics(corridor: Path, tiles: Path, made: Path, pictures: Path) -> dict[str, Any]:
    """Jump and step at the border between the first two tiles of a survey of the photos of `corridor`."""
    scene = read_scene(made)
    first, second = scene.tiles[:2]
    layers = [_in_world(first), _in_world(second)]
    cell = read_tile(tiles / first.name).cell
    assert cell is not None
    origin = np.asarray(scene.origin)

    def beyond(xyz: F64) -> F64:
        """(N,) metres by which positions (N, 3) in the world are in the second tile."""
        return cell.beyond(second.name, xyz[:, :2] + origin[:2])

    views = photos(corridor, made / "none", origin)
    near = [photo for photo in views.values() if abs(beyond(photo.T[None, :3, 3])[0]) < NEAR_M]
    every = Splats(np.concatenate([layer.splats.parameters for layer in layers]))
    sides = [SplatRenderer(replace(layer, splats=every)) for layer in layers]
    apart = [_difference(sides, photo, pictures / f"border_{k}.png") for k, photo in enumerate(near)]
    steps = [step for photo in near if (step := _step(sides[0], photo, beyond)) is not None]
    differences = _frames(WorldCamera(scene), min(near, key=lambda photo: abs(beyond(photo.T[None, :3, 3])[0])))
    return {
        "photos": [len(layer.photos) for layer in layers],
        "differences": differences.tolist(),
        "steps": [step.tolist() for step in steps],
        "border_grey_levels": float(differences.max() - np.median(differences)),
        "background_grey_levels": max(apart),
        "border_step_grey_levels": float(np.abs(np.mean(steps, axis=0)).mean()),
    }


def _frames(world: WorldCamera, photo: Photo) -> F64:
    """(N,) mean differences in grey levels between frames and the next ones, on a straight way through a photo."""
    camera, images = camera_of(photo).scaled(FRAME_SCALE), []
    for ahead in np.arange(-NEAR_M, NEAR_M, FRAME_M):
        pose = photo.T.copy()
        pose[:3, 3] += ahead * pose[:3, 2]
        images.append(world.render(pose, camera).rgb.astype(float))
    return np.array([np.abs(image - before).mean() for before, image in pairwise(images)])


def _in_world(tile: SceneTile) -> SplatLayer:
    layer = tile.splats()
    assert layer is not None
    layer.splats.parameters[:, XYZ] += np.asarray(tile.offset, np.float32)
    return layer


def _difference(sides: Sequence[SplatRenderer], photo: Photo, picture: Path) -> float:
    """Mean difference in grey levels with the background of either tile; writes photo and images below each other."""
    from PIL import Image

    images = [side.view(camera_of(photo), photo.T).rgb for side in sides]
    picture.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack([photo.rgb, *images])).save(picture)
    return float(np.abs(images[0].astype(float) - images[1]).mean())


def _step(renderer: SplatRenderer, photo: Photo, beyond: Callable[[F64], F64]) -> F64 | None:
    """(3,) grey levels by which the first tile is brighter than the second, relative to a photo; None: it shows one."""
    camera = camera_of(photo)
    image = renderer.view(camera, photo.T)
    seen = np.isfinite(image.range)
    xyz = photo.T[:3, 3] + image.range[seen, None] * (pixel_rays(camera)[seen] @ photo.T[:3, :3].T)
    at = np.full(seen.shape, np.inf)
    at[seen] = beyond(xyz)
    here, there = (at <= 0) & (at > -NEAR_M), (at > 0) & (at < NEAR_M)
    if min(here.mean(), there.mean()) < MIN_SHARE:
        return None
    like = score.apply_gain(image.rgb, score.solve_gain(photo.rgb, image.rgb, here | there))
    brighter = like - photo.rgb
    return np.asarray(brighter[here].mean(axis=0) - brighter[there].mean(axis=0))


def table(found: Mapping[str, Any]) -> None:
    """Print jump and step."""
    print(
        f"\nborder of two tiles: jump {found['border_grey_levels']:.2f} grey levels (backgrounds differ by "
        f"{found['background_grey_levels']:.2f}), step within the picture {found['border_step_grey_levels']:.2f}"
    )
