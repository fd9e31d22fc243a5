"""Splats across the border of two tiles of a survey: a street that is cut in two, each half trained on its own photos.

`border_grey_levels` is the jump that a camera sees when it crosses the border: the mean difference, in grey levels, of
what `scan2sim.camera` and `scan2sim view` show there of both tiles on this side of it and on the other; at the photos
within `NEAR_M` of the border, and the worst of them. `border_step_grey_levels` is the step within a picture: how much
brighter one tile is than the other, within `NEAR_M` of the border, than the photos that show both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
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

LENGTH_M, PHOTO_DISTANCE_M = 14.0, 10.0
"""Length of the tiles, and distance beyond a border from which photos are used (40 m of a tile of 100 m)."""
SETTINGS = ("splats.when=auto", "voxel.size=0.2", "unwrap.texel=0.04", "pictures.width=640")
"""Settings of the survey: meshes are coarser than by default, splats are not."""
NEAR_M = 5.0
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

    views = list(photos(corridor, made / "none", origin).values())
    near = [photo for photo in views if abs(beyond(photo.T[None, :3, 3])[0]) < NEAR_M]
    every = Splats(np.concatenate([layer.splats.parameters for layer in layers]))
    sides = [SplatRenderer(replace(layer, splats=every)) for layer in layers]
    jumps = [_jump(sides, photo, pictures / f"border_{k}.png") for k, photo in enumerate(near)]
    steps = [step for photo in near if (step := _step(sides[0], photo, beyond)) is not None]
    return {
        "jumps": jumps,
        "steps": [step.tolist() for step in steps],
        "border_grey_levels": max(jumps),
        "border_step_grey_levels": float(np.abs(np.mean(steps, axis=0)).mean()),
        "photos": [len(layer.photos) for layer in layers],
    }


def _in_world(tile: SceneTile) -> SplatLayer:
    layer = tile.splats()
    assert layer is not None
    layer.splats.parameters[:, XYZ] += np.asarray(tile.offset, np.float32)
    return layer


def _jump(sides: Sequence[SplatRenderer], photo: Photo, picture: Path) -> float:
    """Mean difference of both sides' images in grey levels; writes them, one below the other."""
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
        f"\nborder of two tiles: jump {found['border_grey_levels']:.2f} grey levels at the worst of "
        f"{len(found['jumps'])} photos, step within the picture {found['border_step_grey_levels']:.2f}"
    )
