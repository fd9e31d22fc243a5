"""The benchmarks' independent reader of exported worlds; run as a program, as tests don't import benchmarks."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.io import world_formats
from scan2sim.pipeline.io.world_formats import SceneParams
from tests.fakes import synthetic

ROOT = Path(__file__).resolve().parents[1]
READ = """
import json, sys
from pathlib import Path
import numpy as np
from bench.street.world import Photo, World
world = World(Path(sys.argv[1]))
pose = np.array(json.loads(sys.argv[2]))
K = np.array([[100.0, 0, 79.5], [0, 100, 59.5], [0, 0, 1]])
found = world.render(Photo(np.zeros((120, 160, 3), np.uint8), K, pose, 0.0))
print(json.dumps({
    "surfaces": sorted(set(world.surfaces)), "sky": world.sky, "hit": float(found.hit.mean()),
    "top": found.whole[0, 80].tolist(), "surface_top": found.rgb[0, 80].tolist(),
    "same": bool((found.whole == found.rgb)[found.hit].all()), "low": world.vertices.min(axis=0).tolist(),
    "layer": float(found.backdrop[0, 80]),
}))
"""


def read(world: Path) -> dict[str, Any]:
    """Contents of a world by the reader, seen from 12 m south of its origin, 6 m above it, looking north."""
    pose = np.array([[1.0, 0, 0, 0], [0, 0, 1, -12], [0, -1, 0, 6], [0, 0, 0, 1]])
    command = [sys.executable, "-c", READ, str(world), json.dumps(pose.tolist())]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A world in Gazebo's format: visual meshes, and collision meshes, which have no UV coordinates."""
    folder = tmp_path_factory.mktemp("world")
    scene = synthetic.scene(folder / "scene", tiles=1)
    sunny = replace(scene, tiles=(replace(scene.tiles[0], sky=(120, 160, 220)),))
    world_formats.write(sunny, ["gazebo"], folder / "world", SceneParams(), silent)
    return folder / "world"


def test_surfaces_are_read_without_collision_meshes(world: Path) -> None:
    assert list(world.rglob("collision_*.obj"))
    found = read(world)
    assert found["surfaces"] == ["building", "terrain"] and 0.2 < found["hit"] < 0.9
    assert found["sky"] == found["top"] == [120, 160, 220]


def test_backdrop_is_visible_but_not_a_surface(world: Path) -> None:
    """A green wall 60 m to the north."""
    bare = read(world)
    meshes = next((world / "models").iterdir()) / "meshes"
    cv2.imwrite(str(meshes / "backdrop.png"), np.full((4, 4, 3), (10, 200, 30), np.uint8)[..., ::-1])
    (meshes / "backdrop.mtl").write_text("newmtl leaves\nmap_Kd backdrop.png\n", encoding="utf-8")
    corners = "v -90 60 -90\nv 90 60 -90\nv 90 60 90\nv -90 60 90\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    obj = f"mtllib backdrop.mtl\n{corners}usemtl leaves\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    (meshes / "backdrop.obj").write_text(obj, encoding="utf-8")
    found = read(world)
    assert found["top"] == [10, 200, 30] and found["surface_top"] == [120, 160, 220]
    assert 70 < found["layer"] < 95 and bare["layer"] == np.inf
    assert found["same"] and {k: found[k] for k in ("surfaces", "hit", "low")} == {
        k: bare[k] for k in ("surfaces", "hit", "low")
    }


SHARES = """
import json
import numpy as np
from types import SimpleNamespace
from bench.street import frame
from bench.street.world import Rendering
photo = SimpleNamespace(rgb=np.full((40, 60, 3), 100, np.uint8))
whole = np.full((40, 60, 3), 100, np.uint8)
whole[:, 20:40], whole[:, 40:] = 110, 130
far = np.where(np.arange(60) < 20, 5.0, np.inf) * np.ones((40, 1))
layers = np.where(np.arange(60) // 20 == 1, 30.0, np.inf) * np.ones((40, 1))
rendering = Rendering(whole, far, np.where(far < 9, 0, -1), whole, layers)
every = np.ones((40, 60), bool)
_, sums = frame.metrics(photo, rendering, SimpleNamespace(surfaces=["terrain"]), every, np.ones(3), every)
print(json.dumps({name: [row["share"], row["error_share"]] for name, row in frame.pooled([sums]).items()}))
"""


def test_frame_error_is_split_by_surface_layer_and_dome() -> None:
    """A third of the frame each: right surface, a layer 10 levels off, the dome 30 levels off."""
    done = subprocess.run([sys.executable, "-c", SHARES], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    for name, error in (("surface", 0.0), ("terrain", 0.0), ("layer 20-60 m", 0.1), ("dome: sky", 0.9)):
        assert found[name] == pytest.approx([1 / 3, error])
    assert found["no surface: sky"] == pytest.approx([2 / 3, 1.0])


COMPARE = """
import json, sys
from pathlib import Path
import numpy as np
from bench.street import openmvs
from bench.street.world import Photo, World
world = World(Path(sys.argv[1]))
K = np.array([[100.0, 0, 79.5], [0, 100, 59.5], [0, 0, 1]])
pose = np.array(json.loads(sys.argv[2]))
photo = Photo(np.zeros((120, 160, 3), np.uint8), K, pose, 0.0)
seen = world.render(photo)
photo = Photo(seen.rgb, K, pose, 0.0)  # the world is perfect
other = openmvs.textured_mesh(Path(sys.argv[3]), "street", world.meshes, {}, Path("unused"))
print(json.dumps(openmvs.compare([(photo, seen, seen.hit)], other) | {"hit": float(seen.hit.mean())}))
"""


def test_fill_colour_of_openmvs_is_not_texture(world: Path, tmp_path: Path) -> None:
    """Result of OpenMVS: the ground of the world, half of which is in no photo."""
    meshes = next((world / "models").iterdir()) / "meshes"
    folder = tmp_path / "mvs" / "street"
    folder.mkdir(parents=True)
    cv2.imwrite(
        str(folder / "page.png"), np.array([[[60, 90, 90], [41, 136, 255]]], np.uint8).repeat(64, 0).repeat(32, 1)
    )
    (folder / "textured.mtl").write_text("newmtl page\nmap_Kd page.png\n", encoding="utf-8")
    lines = (meshes / "terrain.obj").read_text(encoding="utf-8").splitlines()
    vertices = [line for line in lines if line.startswith("v ")]
    faces = [[corner.split("/")[0] for corner in line.split()[1:]] for line in lines if line.startswith("f ")]
    texture = [f"f {' '.join(f'{v}/{1 + i % 2}' for v in face)}" for i, face in enumerate(faces)]
    text = ["mtllib textured.mtl", *vertices, "vt 0.25 0.5", "vt 0.75 0.5", "usemtl page", *texture]
    (folder / "textured.obj").write_text("\n".join(text), encoding="utf-8")
    pose = [[1.0, 0, 0, 0], [0, 0, 1, -12], [0, -1, 0, 6], [0, 0, 0, 1]]
    command = [sys.executable, "-c", COMPARE, str(world), json.dumps(pose), str(tmp_path / "mvs")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert 0.1 * found["hit"] < found["pixels"] < 0.6 * found["hit"]
    assert found["gain_db"] > 5 and found["theirs_psnr_db"] < 40
