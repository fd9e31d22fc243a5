"""Levels of detail: sizes, stated geometric errors, and no cracks between neighbouring levels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.camera import renderer
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import Level, Scene, read_scene, save_tile, write_scene_file
from scan2sim.pipeline.io.worlds.textured_mesh import save_reflectance
from scan2sim.texturing import levels_of_detail as texturing_levels
from scan2sim.texturing.levels_of_detail import shared_borders, with_levels
from tests.fakes import synthetic
from tests.fakes.consumers import seams
from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference
from tests.present import present

TILES, SIDE = 3, 20.0
NOWHERE = WorldReference(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))


@pytest.fixture(scope="module")
def strip(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Tiles of bumpy ground with three levels each, merged into one root level."""
    folder = tmp_path_factory.mktemp("strip")
    return with_levels(row(folder, TILES), 3, folder / "levels", silent)


def row(folder: Path, tiles: int) -> Scene:
    """Row of tiles cut out of one bumpy ground."""
    names = []
    for i in range(tiles):
        x, y, z = synthetic.UTM.origin
        frame = replace(synthetic.UTM, origin=(x + SIDE * i, y, z))
        mesh = synthetic.ground(80, frame)
        vertices = mesh.vertices.copy()
        vertices[:, 2] = synthetic.height(vertices[:, 0] + SIDE * i, vertices[:, 1])
        source = synthetic.textured(folder / f"tile{i}", replace(mesh, vertices=vertices))
        save_reflectance(source, ramp(vertices[:, 0] + SIDE * i))
        synthetic.collided(frame).save(folder / f"solid{i}.npz")
        save_tile(folder / "world", f"tile{i}", {"terrain": source}, folder / f"solid{i}.npz", {}, 0.8)
        names.append(f"tile{i}")
    write_scene_file(folder / "world", "strip", synthetic.UTM, names)
    return read_scene(folder)


def ramp(x: np.ndarray) -> np.ndarray:
    """Reflectance along the strip: from 0 in the west to 1 in the east."""
    return ((x + SIDE / 2) / (TILES * SIDE)).astype(np.float32)


def every(level: Level) -> Iterator[Level]:
    yield level
    for finer in level.finer:
        yield from every(finer)


def levels(scene: Scene) -> list[Level]:
    assert scene.coarse is not None
    return list(every(scene.coarse))


def covered(level: Level) -> set[str]:
    return {one.tile.name for one in every(level) if not one.finer}


def mesh(level: Level) -> Mesh:
    """Ground mesh of a level, metres from the scene's origin."""
    own = level.tile.textured()["terrain"].mesh
    return replace(own, vertices=(own.vertices + np.array(level.tile.offset)).astype(np.float32))


def distance_to_mesh(mesh: Mesh, places: np.ndarray) -> np.ndarray:
    found, _ = renderer.Renderer([renderer.Body(mesh)]).closest_points(places.astype(np.float32))
    return np.asarray(np.linalg.norm(found - places, axis=1))


def test_each_level_has_a_quarter_of_the_finer_triangles(strip: Scene) -> None:
    every = levels(strip)
    assert [level.height for level in every if covered(level) == {"tile0"}] == [2, 1, 0]
    assert strip.coarse is not None and covered(strip.coarse) == {"tile0", "tile1", "tile2"}
    for level in (one for one in every if one.finer):
        count = sum(len(mesh(finer)) for finer in level.finer)
        assert 0.15 * count < len(mesh(level)) < 0.4 * count
        assert 1.8 < level.texel / np.mean([finer.texel for finer in level.finer]) < 4


def test_stated_error_bounds_the_distance_to_the_surface(strip: Scene) -> None:
    side = np.linspace(-9.9, 9.9, 60)
    x, y = (one.ravel() for one in np.meshgrid(side, side))
    for level in levels(strip):
        shift = strip.tiles[[tile.name for tile in strip.tiles].index(level.tile.name)].offset[0]
        true = np.column_stack([x + shift, y, synthetic.height(x + shift, y)])
        assert np.percentile(distance_to_mesh(mesh(level), true), 95) < level.error + 0.01
        assert level.error > max((finer.error for finer in level.finer), default=-1)


def test_levels_keep_the_reflectance(strip: Scene) -> None:
    for level in levels(strip):
        shape = level.tile.textured()["terrain"]
        expected = ramp(shape.mesh.vertices[:, 0] + level.tile.offset[0])
        assert np.abs(present(shape.reflectance) - expected).max() < 0.03


def test_no_cracks_between_neighbouring_levels(strip: Scene) -> None:
    found = shared_borders(strip)
    assert {(one.tile, one.other) for one in found} == {
        ("tile0", "tile1"), ("tile1", "tile0"), ("tile1", "tile2"), ("tile2", "tile1")
    }  # fmt: skip
    for border in found:
        along = border.points[np.argsort(border.points[:, 1])]
        assert len(along) == 81
        between = np.linspace(along[:-1], along[1:], 5).reshape(-1, 3)
        for level in levels(strip):
            if border.tile in covered(level) and border.other not in covered(level):
                assert distance_to_mesh(mesh(level), between).max() < 1e-4


def test_no_gap_between_coarse_and_fine_ground(strip: Scene) -> None:
    left, right = ([one for one in levels(strip) if covered(one) == {name}] for name in ("tile0", "tile1"))
    low, high = (SIDE / 2 - 1, -9.9, -2), (SIDE / 2 + 1, 9.9, 2)
    for a, b in product(left, right):
        seen = renderer.Renderer([renderer.Body(mesh(a)), renderer.Body(mesh(b))]).above(low, high, width=400)
        assert seen.hit.all()


def test_inner_borders_of_merged_tiles_are_simplified(strip: Scene) -> None:
    assert strip.coarse is not None
    own = mesh(strip.coarse).vertices
    inner = np.abs(own[:, 0] - SIDE / 2) < 1e-3
    assert inner.sum() < 40  # of 81


def test_coarser_levels_look_like_the_finest(strip: Scene) -> None:
    images = []
    for level in [one for one in levels(strip) if covered(one) == {"tile1"}]:
        scene = renderer.Renderer([renderer.textured(level.tile.folder / "terrain")])
        images.append(scene.above((-10, -10, -1), (10, 10, 1), width=100).rgb.astype(float))
    for coarse in images[:-1]:
        assert np.median(np.abs(coarse - images[-1])) < 3 and np.abs(coarse - images[-1]).mean() < 12


def test_seam_check_detects_cracks_in_exported_levels(
    strip: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world_formats.write(strip, ["tiles3d"], tmp_path / "closed", SceneParams(), silent)
    figures = seams.check(tmp_path / "closed", NOWHERE)
    assert (figures["tiles"], figures["finest"]) == (10, 3) and figures["borders_m"] == pytest.approx(40, abs=1)
    monkeypatch.setattr(texturing_levels, "shared_borders", lambda scene: [])
    cracked = with_levels(row(tmp_path, 2), 2, tmp_path / "levels", silent)
    world_formats.write(cracked, ["tiles3d"], tmp_path / "open", SceneParams(), silent)
    with pytest.raises(Fault, match="cracks between levels"):
        seams.check(tmp_path / "open", NOWHERE)
