"""Simplified textured meshes keep their appearance, classes and borders."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scan2sim.pipeline.camera import renderer
from scan2sim.pipeline.core.step import silent
from scan2sim.texturing.simplify_textured import simplified_scene
from tests.fakes import synthetic

TEXELS = 40_000


def test_simplified_scene_meets_the_budget_and_keeps_its_appearance(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path / "town", tiles=1)
    small = simplified_scene(scene, 120, TEXELS, tmp_path / "small", silent)
    old, new = (s.tiles[0] for s in (scene, small))
    assert sum(g["triangles"] for g in new.groups.values()) <= 126 < sum(g["triangles"] for g in old.groups.values())
    pages = [page for shape in new.textured().values() for page in shape.pages]
    assert sum(np.prod(cv2.imread(str(page)).shape[:2]) for page in pages) <= TEXELS
    assert {surface.code for surface in new.surfaces()} == {surface.code for surface in old.surfaces()}
    assert all(not np.any(shape.photo) for shape in new.textured().values()) and len(new.views()) == 1
    assert new.low == old.low and new.high[:2] == old.high[:2]
    pose = renderer.look_at((-12, -9, 12), (0, 0, 0))
    images = [
        renderer.Renderer([renderer.textured(tile.folder / group) for group in tile.groups])
        .view(renderer.pinhole(160, 120), pose)
        .rgb.astype(float)
        for tile in (old, new)
    ]
    assert np.median(np.abs(images[0] - images[1])) < 3 and np.abs(images[0] - images[1]).mean() < 12


def test_tiles_within_budget_are_unchanged(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path / "town", tiles=2)
    same = simplified_scene(scene, 100_000, 1e9, tmp_path / "same", silent)
    for old, new in zip(scene.tiles, same.tiles, strict=True):
        assert (new.offset, new.groups) == (old.offset, old.groups)
        assert (new.folder / "terrain/page_0.png").samefile(old.folder / "terrain/page_0.png")
