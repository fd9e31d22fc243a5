"""Pictures of a world: from above without what is over the sensor, and from the robot's start all around."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from bench.maps.chain import World
from bench.maps.inputs import BenchMap
from scan2sim.pipeline.camera.renderer import Body, Renderer
from scan2sim.pipeline.core.types import Camera

CUT_ABOVE_SENSOR_M = 1.0
"""Height above the sensor from which rays of the view from above start, below ceilings."""
WIDTH_PX = 1600
MARGIN_M = 1.0


def take(one: BenchMap, world: World, out: Path) -> list[Path]:
    """Write `<out>_above.png` and `<out>_inside.png`; returns their paths."""
    bodies = []
    for tile in world.scene.tiles:
        for shape in tile.textured().values():
            vertices = shape.mesh.vertices + np.asarray(tile.offset, np.float32)
            bodies.append(Body(replace(shape.mesh, vertices=vertices), shape.pages))
    renderer = Renderer(bodies)
    points = world.place(one.xyz)
    eye = world.place(one.sensor[None])[0]
    low, high = (np.percentile(points, q, axis=0) + shift for q, shift in ((1, -MARGIN_M), (99, MARGIN_M)))
    high[2] = eye[2] + CUT_ABOVE_SENSOR_M - 1.0  # the renderer's rays start 1 m above the box
    low[2] = min(low[2], high[2] - 1.0)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # looks along x
    pose[:3, 3] = eye
    images = {
        "above": renderer.above(low, high, width=WIDTH_PX, samples=2),
        "inside": renderer.view(Camera("equirectangular", WIDTH_PX, WIDTH_PX // 2), pose, samples=2),
    }
    files = []
    out.parent.mkdir(parents=True, exist_ok=True)
    for name, image in images.items():
        files.append(out.with_name(f"{out.name}_{name}.png"))
        cv2.imwrite(str(files[-1]), image.rgb[..., ::-1])
    return files
