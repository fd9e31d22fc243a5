"""Worlds of real recordings, loaded by Gazebo: a KITTI street, four airborne tiles, a cloud without CRS."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.fakes.gazebo.checker import check_world
from tests.flows.command import scan2sim, stdout_of

pytestmark = pytest.mark.slow


def run(tile: Path, out: Path, *options: object) -> dict[str, Any]:
    """Run the command with default settings and load the world in Gazebo; returns the report."""
    stdout_of(scan2sim("run", tile, "--out", out, *options, timeout=1800))
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    ground = json.loads((out / "world" / "metadata.json").read_text(encoding="utf-8"))["groups"]["terrain"]
    x, y, _ = ((a + b) / 2 for a, b in zip(ground["low_m"], ground["high_m"], strict=True))
    above = (x, y, ground["high_m"][2] + 2)
    seen = check_world(next((out / "world").glob("*.sdf")), ("box", above))
    shown = sum(mesh["triangles"] for mesh in seen["meshes"] if mesh["role"] == "visual")
    assert shown == sum(report["world"]["triangles"].values())
    return report


def test_kitti_street(real_data: Path, tmp_path: Path) -> None:
    drive = real_data / "kitti_raw0009_f00-24"
    poses = drive / "T_velo0_velo_icp_frames_0-24.txt"
    stdout_of(scan2sim("import", "kitti-raw", drive, "--poses", poses, "--out", tmp_path / "tile"))
    report = run(tmp_path / "tile", tmp_path / "out", "--hold-out", 8)
    assert report["geometry"]["cloud_to_mesh_mean_m"]["terrain"] < 0.05
    assert report["texture"]["psnr_db"] > 16.5 and report["texture"]["ssim"] > 0.7


def test_four_airborne_tiles_without_photos(real_data: Path, tmp_path: Path) -> None:
    stdout_of(scan2sim("import", "las", *sorted((real_data / "las").glob("ign_77*.laz")), "--out", tmp_path / "tile"))
    report = run(tmp_path / "tile", tmp_path / "out")
    assert report["crs"].startswith("EPSG:2154")
    assert set(report["geometry"]["triangles"]) == {"terrain", "building", "vegetation"}
    assert report["geometry"]["cloud_to_mesh_mean_m"]["terrain"] < 0.1


def test_cloud_without_crs(real_data: Path, tmp_path: Path) -> None:
    stdout_of(
        scan2sim("import", "las", real_data / "las" / "sample_c.las", "--crs", "local", "--out", tmp_path / "tile")
    )
    report = run(tmp_path / "tile", tmp_path / "out")
    assert report["crs"] == "no CRS"
