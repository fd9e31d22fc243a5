"""`scan2sim camera`: what its options give the node, and what it rejects before anything runs."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("cyclonedds", reason="the extra bus isn't installed")

from scan2sim.flows.cli import app
from scan2sim.flows.commands import camera
from scan2sim.pipeline.core.errors import InputError, ScanError, SettingError
from scan2sim.services.world_camera import node
from tests.fakes import synthetic

Given = tuple[Any, Any, Any]
"""Arguments of the node: world, settings, origin."""
START = {"position_m": [4.0, 5.0, 0.5], "angles_rad": [0.0, 0.0, math.pi], "on": "road"}


@pytest.fixture
def world(tmp_path: Path) -> Path:
    scene = synthetic.scene(tmp_path)
    folder = scene.tiles[0].folder.parents[1]
    metadata = {"spawn": START, "T_world_map": np.diag([1.0, -1, -1, 1]).tolist()}
    (folder / "metadata.json").write_text(json.dumps(metadata), encoding="utf-8")
    return folder


def nodes_of(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> list[Given]:
    """Arguments of the nodes that a command creates.

    Raises:
        ScanError: the command's.
    """
    created: list[Given] = []
    monkeypatch.setattr(node, "WorldCameraNode", lambda *given: created.append(given))
    monkeypatch.setattr(camera, "spin", lambda create: create())
    result = CliRunner().invoke(app, ["camera", *map(str, arguments)])
    if result.exception is not None:
        raise result.exception
    return created


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--odometry", "/odom"), [-1, 0, 0, 4]),
        (("--frame", "eye", "--fixed-frame", "odom"), [-1, 0, 0, 4]),
        (("--frame", "eye", "--fixed-frame", "map"), [1, 0, 0, 0]),
        (("--frame", "eye"), [1, 0, 0, 0]),
        (("--odometry", "/odom", "--origin", "1", "2", "3", "0", "0", "90"), [0, -1, 0, 1]),
    ],
)
def test_origin_is_that_given_or_where_the_robot_starts(
    world: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], expected: list[float]
) -> None:
    [(_, params, origin)] = nodes_of(monkeypatch, world, *options)
    assert np.allclose(origin[0], expected)
    assert params.odometry == ("/odom" if "--odometry" in options else None)


def test_map_is_placed_by_its_transform(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    [(_, _, origin)] = nodes_of(monkeypatch, world, "--frame", "eye", "--fixed-frame", "map")
    assert np.array_equal(origin, np.diag([1.0, -1, -1, 1]))


def test_options_reach_the_node_and_the_world(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = "--frame eye --mount 1 2 3 -4 5 -6 --readout 0.02 --exposure -1.5 --rate 5 --topic /photo --farthest 50"
    [(shown, params, _)] = nodes_of(monkeypatch, world, *options.split())
    assert params.mount == (1, 2, 3, -4, 5, -6) and params.topic == "/photo"
    assert (params.readout, params.exposure, params.rate) == (0.02, -1.5, 5)
    assert shown._farthest == 50


@pytest.mark.parametrize(
    ("options", "where", "message"),
    [
        ((), "--frame", "isn't known"),
        (("--frame", "eye", "--image", "/a"), "--image", "--depth-image"),
        (("--frame", "eye", "--depth-image", "/a"), "--image", "--depth-image"),
        (("--camera-info", "/world_camera/camera_info"), "--camera-info", "published by this camera"),
        (("--frame", "eye", "--rate", "0"), "--rate", "0.01 to 1,000"),
        (("--frame", "eye", "--field", "nan"), "--field", "1 to 170"),
        (("--frame", "eye", "--origin", "1e300", "0", "0", "0", "0", "0"), "--origin", "6 numbers"),
        (("--frame", "eye", "--topic", "a b"), "--topic", "(got 'a b')"),
    ],
)
def test_wrong_options_are_rejected(
    world: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], where: str, message: str
) -> None:
    with pytest.raises(SettingError) as caught:
        nodes_of(monkeypatch, world, *options)
    assert caught.value.where == where and message in str(caught.value)


def test_a_folder_without_a_world_or_a_start_is_rejected(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="contains no world"):
        nodes_of(monkeypatch, tmp_path / "none", "--frame", "eye")
    (world / "metadata.json").write_text("{}", encoding="utf-8")
    with pytest.raises(ScanError, match="--origin"):
        nodes_of(monkeypatch, world, "--odometry", "/odom")
