"""The film of a robot in MuJoCo, whose cameras see the world; run as a program, as tests don't import benchmarks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from tests.conftest import ROOT
from tests.fakes import synthetic
from tests.fakes.consumers import mujoco as consumer

SIZE = (96, 54)


def test_robot_drives_through_the_world_and_is_filmed(tmp_path: Path) -> None:
    if why := consumer.missing():
        pytest.skip(why)
    world = synthetic.driven(tmp_path).tiles[0].folder.parents[1]
    command = [sys.executable, "-m", "bench.robot_film", "--world", world, "--out", tmp_path / "film"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [*map(str, command), "--seconds", "1", "--size", *map(str, SIZE)],
        cwd=ROOT, env=environment, check=True, capture_output=True, text=True,
    )  # fmt: skip
    result = json.loads(done.stdout.split("RESULT", 1)[1])
    assert result["frames"] == 10 and 0.3 < result["driven_m"] < 1.1
    assert 0.01 < result["pixels_of_bodies"] < 0.5, "the robot is in front of the following camera"
    film = cv2.VideoCapture(str(tmp_path / "film" / "film.mp4"))
    images = []
    while (read := film.read())[0]:
        images.append(read[1])
    assert len(images) == 10 and images[-1].shape == (SIZE[1], SIZE[0], 3) and images[-1].std() > 10
    sheet = cv2.imread(str(tmp_path / "film" / "sheet.png"))
    assert sheet is not None and sheet.shape == (4 * SIZE[1] // 2, 4 * SIZE[0] // 2, 3)
