"""Hidden files are no data: macOS leaves `._NAME` beside every file on exFAT and network drives."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from scan2sim.pipeline.importers.bag import reader
from scan2sim.pipeline.importers.robot_map import map_files
from scan2sim.pipeline.io.mesh_files import find_mesh
from scan2sim.pipeline.io.sweep_files import list_files
from scan2sim.services.toolboxes import sources
from scan2sim.slam import video


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("map.pcd", map_files),
        ("1.bin", list_files),
        ("model.obj", lambda folder: [find_mesh(folder)]),
        ("drive.mcap", reader._paths),
        ("1.png", sources._image_files),
        ("1.png", video._files),
    ],
)
def test_files_of_macos_beside_data_are_skipped(
    name: str, found: Callable[[Path], list[Path]], tmp_path: Path
) -> None:  # fmt: skip
    for file in (f"._{name}", name, ".DS_Store"):
        (tmp_path / file).write_bytes(b"content")
    assert found(tmp_path) == [tmp_path / name]
