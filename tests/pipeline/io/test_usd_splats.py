"""Splats in OpenUSD: the schema's attributes, and variants that show splats or surfaces, with the same collision."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr", reason="the extra usd isn't installed")

from pxr import Usd, UsdGeom, UsdPhysics

from scan2sim.pipeline.core.splats import SplatLayer, Splats
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.splat_files import SH_C0
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.io.worlds.scene import SPLATS_FILE
from tests.fakes import synthetic


def some(number: int = 300) -> Splats:
    random = np.random.default_rng(1)
    return Splats.of(
        random.uniform(-5, 5, (number, 3)), np.exp(random.uniform(-4, -1, (number, 3))),
        random.normal(size=(number, 4)), random.uniform(0.1, 0.9, number), random.uniform(0, 1, (number, 3)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Usd.Stage:
    folder = tmp_path_factory.mktemp("town")
    town = synthetic.scene(folder, tiles=1)
    SplatLayer(some(), np.ones((4, 8, 3), np.float32)).save(town.tiles[0].folder / SPLATS_FILE)
    world_formats.write(town, ["usd"], folder / "usd", SceneParams(), silent)
    (file,) = (folder / "usd").glob("*.usdc")
    return Usd.Stage.Open(str(file))


def only(stage: Usd.Stage, kind: str) -> Usd.Prim:
    (found,) = (prim for prim in stage.Traverse() if prim.GetTypeName() == kind)
    return found


def test_the_schema_has_the_splats(stage: Usd.Stage) -> None:
    prim, given = only(stage, "ParticleField3DGaussianSplat"), some()
    value = {name: np.array(prim.GetAttribute(name).Get())[:300] for name in ("positions", "scales", "opacities")}
    assert np.allclose(value["positions"], given.xyz) and np.allclose(value["scales"], given.scale, rtol=1e-5)
    assert np.allclose(value["opacities"], given.opacity, atol=1e-6)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 0
    colour = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())[:300] * SH_C0 + 0.5
    assert np.allclose(colour, given.rgb, atol=1e-5)
    first = prim.GetAttribute("orientations").Get()[0]
    assert np.allclose([first.GetReal(), *first.GetImaginary()], given.quaternion[0], atol=1e-6)
    low, high = np.array(prim.GetAttribute("extent").Get())
    assert (low < given.xyz.min(axis=0)).all() and (high > given.xyz.max(axis=0)).all()


def test_either_splats_or_surfaces_are_visible_and_collision_stays(stage: Usd.Stage) -> None:
    holder = only(stage, "ParticleField3DGaussianSplat").GetParent()
    variants = holder.GetVariantSet("appearance")
    assert variants.GetVariantSelection() == "surfaces", "they have the classes, and every program draws them"

    def visible() -> tuple[bool, bool, int]:
        splats = UsdGeom.Imageable(only(stage, "ParticleField3DGaussianSplat")).ComputeVisibility() != "invisible"
        meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
        solid = [prim for prim in meshes if prim.HasAPI(UsdPhysics.CollisionAPI)]
        shown = [prim for prim in meshes if "Visual" in str(prim.GetPath())]
        return splats, any(UsdGeom.Imageable(one).ComputeVisibility() != "invisible" for one in shown), len(solid)

    before = visible()
    variants.SetVariantSelection("splats")
    after = visible()
    assert before[:2] == (False, True) and after[:2] == (True, False) and before[2] == after[2] > 0


def test_tiles_of_a_survey_have_no_shell_that_hides_the_next(tmp_path: Path) -> None:
    town = synthetic.scene(tmp_path, tiles=2)
    for tile in town.tiles:
        SplatLayer(some(), np.ones((4, 8, 3), np.float32)).save(tile.folder / SPLATS_FILE)
    world_formats.write(town, ["usd"], tmp_path / "usd", SceneParams(), silent)
    for file in (tmp_path / "usd").rglob("tile*.usdc"):
        stage = Usd.Stage.Open(str(file))
        positions = only(stage, "ParticleField3DGaussianSplat").GetAttribute("positions").Get()
        assert len(positions) == len(some())
