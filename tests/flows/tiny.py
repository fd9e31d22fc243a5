"""Small street that is built in seconds: few points, two photos, coarse settings; steps can be made to fail."""

from __future__ import annotations

import json
import shutil
import sys
import xml.etree.ElementTree as ET
from collections.abc import Collection
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w

from scan2sim.flows import cli
from scan2sim.flows.pipelines import tile as tile_pipeline
from scan2sim.pipeline.core.plugins import find
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report
from scan2sim.pipeline.core.types import Bools, Camera, PointCloud
from scan2sim.pipeline.io import toml, world_formats
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import CameraEntry, camera_entry, camera_of, read_tile
from scan2sim.pipeline.io.world_formats import gazebo
from scan2sim.pipeline.io.worlds import readme
from scan2sim.pipeline.io.worlds.scene import Scene, read_scene
from scan2sim.pipeline.steps.export import EXPORT, export
from tests.fakes.gazebo.checker import build, check_world

COARSE: dict[str, dict[str, Any]] = {
    "voxel": {"size": 0.3},
    "unwrap": {"texel": 0.2},
    "pictures": {"width": 160, "compared": 1},
    "split": {"vegetation": "locations"},
    "export": {"rasters": 0.5},
}


def tiny(
    street: Path, out: Path, every: int = 10, photos: int = 2, *, photo_scale: float = 1.0, truth: bool = True
) -> Path:
    """Write a copy of a generated street with every Nth of its points and its first photos.

    Args:
        street: folder of the generated street.
        out: folder of the copy.
        every: one of this many points is kept.
        photos: number of photos.
        photo_scale: size of the photos relative to the original ones; scoring them takes longest of all steps.
        truth: whether the copy has the ground truth, which takes seconds to compare.
    """
    shutil.copytree(street, out)
    tile = toml.table(out / "tile.toml")
    tile["photos"] = tile["photos"][:photos]
    if not truth:
        del tile["truth"]
    if photo_scale != 1:
        cameras = {entry["id"]: camera_of(out, CameraEntry(**entry)) for entry in tile["cameras"]}
        cameras = {name: camera.scaled(photo_scale) for name, camera in cameras.items()}
        tile["cameras"] = [camera_entry(name, camera) for name, camera in cameras.items()]
        for photo in tile["photos"]:
            resize(out / photo["file"], cameras[photo["camera"]])
    (out / "tile.toml").write_text(tomli_w.dumps(tile), encoding="utf-8")
    keep_points(out, np.arange(len(points(out))) % every == 0)
    return out


def resize(photo: Path, camera: Camera) -> None:
    """Resize a photo to the size of a camera."""
    pixels = cv2.imread(str(photo))
    assert pixels is not None
    cv2.imwrite(str(photo), cv2.resize(pixels, (camera.width, camera.height), interpolation=cv2.INTER_AREA))


def points(tile: Path) -> PointCloud:
    """The cloud of a tile."""
    about = read_tile(tile)
    return las.read(about.clouds[0], about.frame)


def keep_points(tile: Path, kept: Bools) -> None:
    """Remove all other points (N,) from a tile's cloud."""
    las.write(tile / "cloud.laz", points(tile).take(np.flatnonzero(kept)))


def broken(inputs: Inputs, params: Params, out: Path, report: Report, *_: object, **__: object) -> Done:
    """A step with a programming error, raised after half of its result is written."""
    (out / "half.txt").write_text("half", encoding="utf-8")
    raise ZeroDivisionError("a bug")


def broken_part(*arguments: object) -> None:
    """A part of the export with a programming error, raised after half of it is written into its folder, if any."""
    for folder in arguments:
        if isinstance(folder, Path):
            (folder / "half.txt").write_text("half", encoding="utf-8")
    raise ZeroDivisionError("a bug")


PARTS_OF_WORLDS = {
    "lists": (world_formats, "_write_lists"), "navigation": (world_formats, "_write_navigation"),
    "spawn": (world_formats, "default_pose"), "traffic": (gazebo, "write_traffic"), "readme": (readme, "write"),
}  # fmt: skip
"""Optional parts of the export that aren't formats: module and function that write them."""


def export_without(parts: Collection[str], inputs: Inputs, params: Any, out: Path, report: Report) -> Done:
    """The step `export` with failing parts: formats, or of `PARTS_OF_WORLDS`."""
    with pytest.MonkeyPatch.context() as patch:
        for name in parts:
            own = PARTS_OF_WORLDS.get(name)
            module, function = own or (find(world_formats.PACKAGE, name, ""), "write")
            patch.setattr(module, function, broken_part)
        return export(inputs, params, out, report)


def fail(patch: pytest.MonkeyPatch, steps: Collection[str]) -> None:
    """Make the steps of these names fail, and parts of the export such as "export.glb"."""
    parts = [name.removeprefix("export.") for name in steps if name.startswith("export.")]
    if parts:
        patch.setattr(tile_pipeline, "EXPORT", replace(EXPORT, run=partial(export_without, parts)))
    for name in set(steps) - {f"export.{part}" for part in parts}:
        step = getattr(tile_pipeline, name.upper())
        patch.setattr(tile_pipeline, name.upper(), replace(step, run=broken))


def scan2sim(*arguments: object, failing: Collection[str] = (), settings: object = COARSE) -> tuple[int, str]:
    """Run `scan2sim` in this process with coarse settings; returns its exit code and its output as one line.

    Args:
        arguments: of the command.
        failing: steps that fail.
        settings: by step.
    """
    assert isinstance(settings, dict)
    sets = [f"--set={step}.{name}={json.dumps(value)}" for step in settings for name, value in settings[step].items()]
    printed = StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed), redirect_stderr(printed):
        patch.setenv("PYTHONSAFEPATH", "1")
        patch.setattr(sys, "argv", ["scan2sim", *map(str, arguments), *sets])
        fail(patch, failing)
        with pytest.raises(SystemExit) as ended:
            cli.main()
    return int(ended.value.code or 0), " ".join(printed.getvalue().split())


def loaded(out: Path) -> Scene:
    """The finished world of a run or survey, with all meshes read; also loads it in Gazebo if that is installed."""
    scene = read_scene(out)
    assert all(len(shape) for tile in scene.tiles for shape in tile.textured().values())
    assert all(len(tile.solid()) for tile in scene.tiles)
    world = out / "world" / f"{scene.name}.sdf"
    assert ET.parse(world).getroot().find("world") is not None
    if not build():
        check_world(world)
    return scene
