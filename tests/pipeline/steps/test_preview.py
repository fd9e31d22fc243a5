"""Preview: the copy of the world in the report, within size limits."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from scan2sim.pipeline.core.splats import SplatLayer
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.steps.preview import CALLBACK, PREVIEW, PreviewParams
from tests.fakes import splat_scenes, synthetic


@pytest.fixture
def made(tmp_path: Path) -> Any:
    """Make the preview of the synthetic tile, which has four pages of 256 x 256 texels."""
    meshes = {"terrain": synthetic.ground(), "building": synthetic.house()}
    inputs = {group: synthetic.textured(tmp_path / group, mesh) for group, mesh in meshes.items()}

    def make(layer: SplatLayer | None = None, **params: Any) -> Done:
        if layer is not None:
            inputs["splats"] = tmp_path / "splats.npz"
            layer.save(inputs["splats"])
        out = tmp_path / "out"
        out.mkdir()
        return PREVIEW.run(inputs, PreviewParams(**params), out, silent)

    return make


def scene(done: Done) -> trimesh.Scene:
    """Scene in the script."""
    script = (done.files["preview"] / "world.js").read_bytes()
    assert script.startswith(CALLBACK + b'("') and script.endswith(b'");\n')
    return trimesh.load_scene(io.BytesIO(base64.b64decode(script[len(CALLBACK) + 2 : -4])), file_type="glb")


@pytest.mark.parametrize(("megapixels", "side"), [(32, 256), (0.1, 158)])
def test_preview_contains_the_world_within_the_size_limits(made: Any, megapixels: float, side: int) -> None:
    done = made(megapixels=megapixels)
    meshes = scene(done).geometry
    assert sorted(meshes) == ["building_0", "building_1", "terrain_0", "terrain_1"]
    assert sum(len(mesh.faces) for mesh in meshes.values()) == done.metrics["triangles"] == 3210
    heights = np.concatenate([mesh.vertices[:, 1] for mesh in meshes.values()])  # y up
    assert heights.max() == pytest.approx(4.5)
    sizes = [mesh.visual.material.baseColorTexture.width for mesh in meshes.values()]
    assert sizes == [side] * 4 and done.metrics["scale"] == pytest.approx(side / 256, abs=0.01)


def test_preview_camera_starts_on_the_ground(made: Any) -> None:
    metrics = made().metrics
    (x, y, z), target = metrics["walk"]
    assert z - synthetic.height(np.array(x), np.array(y)) == pytest.approx(1.6, abs=0.3)
    assert np.linalg.norm(np.subtract(target, (x, y, z))) > 5 and metrics["turn"][0][2] > 5
    assert metrics["start"] == "turn"  # without a trajectory


def test_world_with_too_many_triangles_has_no_preview(made: Any) -> None:
    done = made(triangles=1000)
    assert done.files == {} and done.metrics == {"triangles": 3210}


def test_preview_contains_splats_unless_there_are_too_many(made: Any) -> None:
    layer = splat_scenes.layer(count=50)
    done = made(layer)
    script = (done.files["preview"] / "splats_data.js").read_text(encoding="ascii")
    assert script.startswith('scan2simSplats("') and done.metrics["splats"] == 50
    assert done.metrics["bytes"] == sum(file.stat().st_size for file in done.files["preview"].iterdir())


@pytest.mark.parametrize("layer", [splat_scenes.layer(count=50), SplatLayer.nothing()])
def test_preview_without_splats(made: Any, layer: SplatLayer) -> None:
    done = made(layer, splats=49)
    assert [file.name for file in done.files["preview"].iterdir()] == ["world.js"] and done.metrics["splats"] == 0
