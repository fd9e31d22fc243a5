"""Files that aren't read: the error says what they are, and what to export instead."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.io import clouds, foreign_files, gps, mesh_files, mesh_models, trajectory


@pytest.mark.parametrize(
    ("name", "read", "message"),
    [
        ("a.USDZ", clouds.read_header, r"unknown cloud format \(\.USDZ\): \.usdz is a USD scene.*as GLB"),
        ("a.rcp", clouds.read_header, r"a cloud of another kind.*E57 or LAZ"),
        ("a.bin", clouds.read_header, r"sweep of KITTI.*import sweeps"),
        ("a.psx", clouds.read_header, r"project of a photogrammetry program.*its cameras"),
        ("a.abc", clouds.read_header, r"unknown cloud format \(\.abc\)\. Use LAS.*meshes \(\.obj.*import map"),
        ("a.bpf", clouds.read_header, r"a cloud of another kind.*E57 or LAZ"),
        ("a.STEP", clouds.read_header, r"a CAD or BIM model.*OBJ or GLB"),
        ("a.3mf", mesh_models.read, r"a mesh or scene.*as GLB, or as OBJ"),
        ("a.fbx", mesh_models.read, r"a mesh or scene.*as GLB, or as OBJ"),
        ("a.pos", gps.read, r"unknown GPS format: \.pos is a solution of RTKLIB.*NMEA"),
        ("a.kml", gps.read, r"Export the recorded track as GPX"),
        ("sbet.out", trajectory.read, r"not a text file: \.out is perhaps a damaged trajectory \(SBET.*as text"),
    ],
)
def test_files_of_other_programs_are_named(
    tmp_path: Path, name: str, read: Callable[[Path], Any], message: str
) -> None:
    (tmp_path / name).write_bytes(bytes(range(256)) * 4)
    with pytest.raises(InputError, match=message):
        read(tmp_path / name)
    shown = CliRunner().invoke(app, ["inspect", str(tmp_path / name)])
    assert isinstance(shown.exception, InputError)


def test_a_missing_file_is_not_taken_for_a_foreign_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"sbet\.out: file not found"):
        trajectory.read(tmp_path / "sbet.out")


def test_no_suffix_is_listed_twice() -> None:
    listed = [suffix for suffixes in foreign_files.KNOWN for suffix in suffixes]
    assert len(listed) == len({*listed})
    assert not {*listed} & {*clouds.formats(), *mesh_files.SUFFIXES}
