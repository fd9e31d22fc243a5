"""`scan2sim inspect` of robots' maps: clouds, folders of clouds, meshes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scan2sim.data_samples.building import Style
from scan2sim.data_samples.mesh_model import write
from scan2sim.pipeline.core.types import F32, U8, Frame, PointCloud
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.robot_maps.label_colours import SEMANTIC_KITTI
from tests.flows.command import in_process, stdout_of
from tests.flows.test_robot_maps import pcd, room

CAMERA_AXES = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], np.float32)
"""From z up to x right, y down, z forward."""


def facts(path: Path) -> dict[str, str]:
    """What `inspect` prints, by name."""
    printed = stdout_of(in_process("inspect", path))
    lines = re.findall(r"^ ([A-Za-z ]+?) {2,}(\S.*?) *$", printed, re.MULTILINE)
    return {name: value for name, value in lines if name}


def test_up_axis_spacing_and_scene_of_a_map_in_camera_axes(tmp_path: Path) -> None:
    found = facts(pcd(tmp_path / "map.pcd", room() @ CAMERA_AXES.T))
    assert found["up axis"].startswith("-y, tilted by 0.")
    assert found["scene"].startswith("indoor") and found["units"].startswith("m ")
    assert float(found["spacing"].split()[0]) == pytest.approx(8, abs=2)  # 12,000 points on 130 m2


def test_folder_of_clouds_is_one_map(tmp_path: Path) -> None:
    xyz = room()
    for i in range(3):
        las.write(tmp_path / f"part{i}.laz", PointCloud(Frame(), xyz[i::3]))
    found = facts(tmp_path)
    assert found["files"] == "3" and found["points"] == f"{len(xyz):,}"
    assert found["up axis"].startswith("z")


def test_label_like_colours_are_reported_with_their_legend(tmp_path: Path) -> None:
    xyz: F32 = room()
    colours: U8 = np.array([rgb for rgb in SEMANTIC_KITTI if any(rgb)][::3], np.uint8)
    cloud = PointCloud(Frame(), xyz, colours[np.arange(len(xyz)) % len(colours)])
    las.write(tmp_path / "map.laz", cloud)
    assert "semantickitti" in facts(tmp_path / "map.laz")["colours"]
    photographed: U8 = np.random.default_rng(0).integers(0, 256, xyz.shape, np.uint8)
    las.write(tmp_path / "map.laz", PointCloud(Frame(), xyz, photographed))
    assert facts(tmp_path / "map.laz")["colours"] == "yes"


def test_up_axis_and_unit_of_a_mesh(tmp_path: Path) -> None:
    path, *_ = write(tmp_path, file_format="obj", up="y", unit="mm", edge=0.4, style=Style(rooms=1))
    for source in (path, tmp_path):
        found = facts(source)
        assert found["up axis"].startswith("y") and found["units"].startswith("mm")
        assert "triangles" in found


def test_up_axis_of_a_gltf_is_named_in_its_own_axes(tmp_path: Path) -> None:
    """A box shows nothing: y is up by the specification. A room that lies on its side shows that z is."""
    box = trimesh.creation.box((4.0, 2.0, 2.5))
    box.export(tmp_path / "box.glb")
    assert facts(tmp_path / "box.glb")["up axis"].startswith("y,")
    path, *_ = write(tmp_path / "room", file_format="glb", up="y", edge=0.4, style=Style(rooms=1))
    assert facts(path)["up axis"].startswith("y,")
    scene = trimesh.load_scene(path)
    scene.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    scene.export(tmp_path / "z_up.glb")
    assert facts(tmp_path / "z_up.glb")["up axis"].startswith("z,")


def test_triangles_of_a_mesh_include_repeated_parts(tmp_path: Path) -> None:
    scene = trimesh.Scene({"box": trimesh.creation.box((4.0, 2.0, 2.5))})
    for x in (8.0, 16.0):
        shift = trimesh.transformations.translation_matrix((x, 0, 0))
        scene.graph.update(frame_from="world", frame_to=f"at {x}", matrix=shift, geometry="box")
    scene.export(tmp_path / "boxes.glb")
    found = facts(tmp_path / "boxes.glb")
    assert (found["parts"], found["triangles"]) == ("3", "36")
