"""Worlds of textured meshes, compared with the building and the colours that the meshes were made from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.data_samples.building import Style
from scan2sim.data_samples.mesh_model import write
from tests.fakes.mesh_truth import measure
from tests.flows.tiny import loaded, scan2sim

ROOM = Style(rooms=1, furniture=0.15)
FINE: dict[str, dict[str, Any]] = {
    "unwrap": {"texel": 0.02},
    "unwrap.vegetation": {"texel": 0.02},
    "decimate": {"target": 10_000},
    "decimate.vegetation": {"target": 10_000},
    "pictures": {"width": 160, "compared": 1},
}
"""Texels are coarse for a fast test: the pattern on the walls has details of 5 cm."""
MIN_PSNR_DB = {"obj": 28.0, "glb": 28.0, "ply": 17.0}
"""Vertex colours, 15 cm apart, can't show the pattern."""


@pytest.mark.slow
@pytest.mark.parametrize(("file_format", "up", "unit"), [("obj", "y", "mm"), ("glb", "y", "m"), ("ply", "z", "m")])
def test_world_has_the_shape_and_the_colours_of_the_mesh(tmp_path: Path, file_format: str, up: str, unit: str) -> None:
    path, made, paint = write(
        tmp_path / "in", file_format=file_format, up=up, unit=unit, style=ROOM  # type: ignore[arg-type]
    )  # fmt: skip
    given = path.parent if file_format == "obj" else path
    code, text = scan2sim("run", given, "--out", tmp_path / "world", settings=FINE)
    assert code == 0, text
    loaded(tmp_path / "world")
    found = measure(tmp_path / "world", made, paint, up)
    assert found["psnr_db"] > MIN_PSNR_DB[file_format], found
    assert found["holes"] < 0.001
    assert found["to_world_p95_m"] < 0.02
    assert found["to_truth_p95_m"] < 0.02
    assert found["right_class"]["floor"] > 0.95
    assert found["right_class"]["wall"] > 0.8
    assert found["right_class"]["ceiling"] > 0.9
    assert max(found["triangles"].values()) <= 10_500


@pytest.mark.parametrize(
    ("name", "content", "cause"),
    [("a.obj", "v 0 0 0\n", "has no faces"), ("a.glb", "nothing", "can't be read as a mesh")],
)
def test_unusable_mesh_is_an_error_without_a_traceback(tmp_path: Path, name: str, content: str, cause: str) -> None:
    (tmp_path / name).write_text(content, encoding="utf-8")
    code, text = scan2sim("run", tmp_path / name, "--out", tmp_path / "world", settings={})
    assert code not in (0, 1)
    assert cause in text
    assert "Traceback" not in text


@pytest.mark.slow
def test_mesh_without_colours_becomes_a_world(tmp_path: Path) -> None:
    n, cell = 60, 0.25
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    z = np.where((x > 25) & (x < 40) & (y > 25) & (y < 40), 3.0, 0.05 * np.sin(x))
    lines = [f"v {a * cell} {b * cell} {c}" for a, b, c in zip(x.ravel(), y.ravel(), z.ravel(), strict=True)]
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel() + 1
    lines += [f"f {i} {i + n} {i + 1}\nf {i + n} {i + n + 1} {i + 1}" for i in corner]
    (tmp_path / "ground.obj").write_text("\n".join(lines), encoding="utf-8")
    code, text = scan2sim(
        "run", tmp_path / "ground.obj", "--out", tmp_path / "world", settings={"unwrap": {"texel": 0.1}}
    )
    assert code == 0, text
    assert "coloured by class" in text
    scene = loaded(tmp_path / "world")
    assert "terrain" in scene.tiles[0].groups
