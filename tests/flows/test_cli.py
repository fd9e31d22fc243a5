"""The command line on a small street: worlds, reports, repeated runs, and results that a setting adds or changes."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import GROUPS, group_of
from scan2sim.pipeline.core.types import Mesh
from scan2sim.pipeline.io.geodata import geotiff
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.services.monitoring.events.schema import Event
from tests.conftest import ROOT
from tests.fakes.broker import Broker
from tests.fakes.browser import chromium
from tests.fakes.gazebo.checker import check_world
from tests.flows.bus_events import read_events
from tests.flows.command import assert_fails, in_process, scan2sim, stdout_of
from tests.flows.inline_steps import inline_steps
from tests.flows.tiny import tiny
from tests.waiting import until

NEXT_FRAME_DRAWN = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"
SMALL = [f"--set={name}" for name in (
    "unwrap.texel=0.1", "decimate.target=10000", "pictures.width=160", "pictures.compared=1")
]  # fmt: skip


@pytest.fixture(scope="module")
def street(small_street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small street with a quarter of its points and half of its photos, of half their size."""
    return tiny(small_street, tmp_path_factory.mktemp("street") / "tile", every=4, photos=4, photo_scale=0.5)


@pytest.fixture(scope="module")
def world(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the small street."""
    out = tmp_path_factory.mktemp("world")
    stdout_of(in_process("run", street, "--out", out, "--hold-out", 2, *SMALL))
    return out


def test_run_publishes_its_progress_on_the_bus(
    street: Path, world: Path, tmp_path: Path, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    out = shutil.copytree(world, tmp_path / "out")
    shutil.rmtree(out / "steps" / "preview")
    command = ("run", street, "--out", out, "--hold-out", 2, *SMALL, "--bus", broker.servers)
    stdout_of(in_process(*command))
    broker.kill()
    assert "nothing to do" in stdout_of(in_process(*command))
    broker.start()
    stdout_of(in_process(*command))  # also sends what the previous run couldn't, and what the broker has lost

    def ended(events: list[Event]) -> list[dict[str, Any]]:
        return [event.body for event in events if event.kind == "run" and event.body["state"] == "done"]

    events, steps = read_events(broker, lambda events: len(ended(events)) == 3), defaultdict[str, set[str]](set)
    for event in events:
        if event.kind == "step":
            steps[event.body["step"]].add(event.body["state"])
    runs, count = [(body["source"], body["cached"], body["done"]) for body in ended(events)], len(steps)
    # events of one run are in order, but runs may arrive in any order: the topic has partitions
    assert sorted(runs) == [(str(street), count - 1, 1), (str(street), count, 0), (str(street), count, 0)]
    assert all("cached" in states for states in steps.values()) and "preview" in steps


@inline_steps()
def test_rasters_are_built_only_if_requested(street: Path, world: Path, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio", reason="rasterio isn't installed")
    out = shutil.copytree(world, tmp_path / "out")
    command = (street, "--out", out, "--hold-out", 2, *SMALL)
    assert "rasters" not in stdout_of(in_process("plan", *command))
    assert not (out / "rasters").exists()
    stdout_of(in_process("run", *command, "--set", "export.rasters=0.1"))
    tile = read_tile(street)
    assert tile.truth_mesh is not None
    truth = Mesh.load(tile.truth_mesh)
    ground = truth.keep(group_of()[truth.classification] == GROUPS.index("terrain"))
    with rasterio.open(next(out.glob("rasters/*_dtm.tif"))) as raster:
        assert raster.crs.to_epsg() == 32633
        middle = truth.frame.to_crs(ground.corners.mean(axis=1))
        height = np.array([value[0] for value in raster.sample(middle[:, :2])], float)
    error = np.abs(height - middle[:, 2])[height > geotiff.NODATA]
    assert len(error) > 1000 and np.median(error) < 0.02 and np.percentile(error, 90) < 0.06
    stdout_of(in_process("run", *command))
    assert not (out / "rasters").exists()  # they were of another run than the world


def test_report_has_a_3d_view_to_orbit_and_walk(world: Path, tmp_path: Path) -> None:
    def eye() -> np.ndarray:
        return np.array(page.value("document.querySelector('output').value").split(), float)

    def walks(start: np.ndarray, hold: Callable[[], None]) -> bool:
        hold()  # for a moment; few frames per second without a GPU
        return bool(np.linalg.norm((eye() - start)[:2]) >= 0.3)

    with chromium(tmp_path) as page:
        page.open(world / "report.html")
        page.click("[data-open]")
        page.until("document.querySelector('header').dataset.state == 'open' && document.querySelector('output').value")
        street, start = page.screenshot()[50:450], eye()
        assert street.std() > 15, "the canvas shows more than one colour"
        until(lambda: walks(start, lambda: page.key("KeyW", "w", 0.3)), what="a step forward")
        assert abs((eye() - start)[2]) < 0.5, "it walks on the ground"
        page.drag((400, 300), (700, 300))
        page.until(NEXT_FRAME_DRAWN)
        assert np.abs(page.screenshot()[50:450].astype(int) - street).mean() > 10
        page.click("[data-to=turn]")
        page.until(f"Number(document.querySelector('output').value.split('  ')[2]) > {start[2] + 5}")
        assert page.errors == []
        page.open(world / "report.html", phone=True, dark=True)
        page.click("[data-open]")
        page.until("document.querySelector('header').dataset.state == 'open'")
        page.until("document.querySelector('output').value")
        street, start = page.screenshot()[50:560], eye()
        page.touch("canvas", 0.3, across=120)
        page.until(NEXT_FRAME_DRAWN)
        assert np.abs(page.screenshot()[50:560].astype(int) - street).mean() > 2 and (eye() == start).all()
        until(lambda: walks(start, lambda: page.touch(".pad [data-key=KeyW]", 0.3)), what="a step forward")
        page.open(Path(shutil.copy(world / "report.html", tmp_path)))  # without its scripts
        page.click("[data-open]")
        page.until("document.querySelector('[role=status]').textContent.includes(\"isn't beside this page\")")


def test_report_without_webgl_shows_the_image_and_the_reason(world: Path, tmp_path: Path) -> None:
    with chromium(tmp_path, "--disable-3d-apis") as page:
        page.open(world / "report.html")
        page.click("[data-open]")
        page.until("document.querySelector('[role=status]').textContent.includes('no WebGL')")
        assert page.value("document.querySelector('header img').getBoundingClientRect().height") > 100
        assert page.errors == []


def test_unencodable_characters_are_printed_as_question_marks(street: Path, tmp_path: Path) -> None:
    tile = shutil.copytree(street, tmp_path / "straße\u2026")
    command = [sys.executable, "-m", "scan2sim.flows.cli", "inspect", str(tile)]
    run = subprocess.run(command, env=os.environ | {"PYTHONIOENCODING": "latin-1"}, cwd=ROOT, capture_output=True)
    assert run.returncode == 0, run.stderr
    assert "straße?" in run.stdout.decode("latin-1").replace("\n", "") and b"Traceback" not in run.stderr


def test_version_and_help() -> None:
    assert stdout_of(scan2sim("--version")).startswith("scan2sim 0.")
    text = stdout_of(scan2sim("--help"))
    assert all(command in text for command in ("run", "plan", "inspect", "import", "sample"))


def test_run_builds_world_and_report(world: Path) -> None:
    assert len(list((world / "world").glob("*.sdf"))) == 1
    report = json.loads((world / "report.json").read_text(encoding="utf-8"))
    for group in ("terrain", "building", "vegetation"):
        assert report["geometry"]["cloud_to_mesh_mean_m"][group] < 0.1
        assert report["geometry"]["truth_mean_m"][group] < 0.2
    assert 0.3 < report["texture"]["coverage"] <= 1
    assert report["texture"]["psnr_db"] > 12 and report["texture"]["psnr_gain_db"] >= report["texture"]["psnr_db"] - 0.5
    assert 0 < report["texture"]["ssim"] < 1 and report["texture"]["truth_psnr_db"] > 12
    assert report["steps"]["poisson.terrain"]["seconds"] > 0 and report["steps"]["poisson.terrain"]["peak_mb"] > 50
    page = (world / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/") >= 8
    assert "http" not in re.sub(r'"data:image/[^"]*"', "", page.split("<main>")[1])


def test_gazebo_loads_the_world_and_a_box_rests_on_the_road(street: Path, world: Path) -> None:
    tile = read_tile(street)
    assert tile.trajectory is not None
    origin = json.loads((world / "world" / "metadata.json").read_text(encoding="utf-8"))["world_origin_m"]
    x, y, z = tile.frame.to_crs(tile.trajectory.positions)[len(tile.trajectory.times) // 4] - origin
    seen = check_world(next((world / "world").glob("*.sdf")), ("box", (float(x), float(y), float(z))))
    (box,) = seen["bodies"]
    assert box["speed"] < 0.1
    assert abs(box["rest"][2] - (z - 2.0 + 0.2)) < 0.15, "the scanner rides 2 m above the road; the box is 40 cm high"
    textures = {texture for mesh in seen["meshes"] for texture in mesh["textures"]}
    groups = {name.removeprefix(f"{tile.name}_").split("_")[0] for name in textures}
    assert groups == {"terrain", "building", "vegetation", "backdrop"}


def test_second_run_does_nothing_and_a_deleted_texture_is_rebuilt(street: Path, world: Path) -> None:
    command = ("run", street, "--out", world, "--hold-out", 2, *SMALL)
    before = {p: p.stat().st_mtime_ns for p in (world / "steps").rglob("*/*") if p.is_file()}
    assert "nothing to do" in stdout_of(in_process(*command))
    assert before == {p: p.stat().st_mtime_ns for p in (world / "steps").rglob("*/*") if p.is_file()}
    next((world / "steps" / "texture.building").rglob("page_0.png")).unlink()
    plan = stdout_of(in_process("plan", *command[1:]))
    assert [line.split()[0] for line in plan.splitlines() if " yes " in line] == ["texture.building"]
    stdout_of(in_process(*command))
    after = {p: p.stat().st_mtime_ns for p in (world / "steps").rglob("*/*") if p.is_file()}
    assert {p.parts[-3] for p in before if before[p] != after.get(p)} <= {"texture.building"} | {
        p.parts[-3] for p in before if "texture.building" in str(p)
    }


def test_plan_lists_the_steps_affected_by_a_setting(street: Path, world: Path) -> None:
    text = stdout_of(
        in_process("plan", street, "--out", world, "--hold-out", 2, *SMALL, "--set", "trim.building.max_edge=0.3")
    )
    again = {line.split()[0] for line in text.splitlines() if " yes " in line}
    assert "trim.building" in again and "texture.terrain" in again  # buildings occlude the terrain
    assert not again & {"ingest", "poisson.building", "trim.terrain", "decimate.terrain"}


def test_inspect_summarizes_cloud_tile_mesh_and_world(street: Path, world: Path) -> None:
    assert "EPSG" in stdout_of(in_process("inspect", street / "cloud.laz"))
    assert "photos" in stdout_of(in_process("inspect", street))
    assert "triangles" in stdout_of(in_process("inspect", next((world / "world").rglob("terrain*.obj"))))
    assert "place" in stdout_of(in_process("inspect", world))
    assert_fails(in_process("inspect", street / "nothing.laz"), 3, "nothing.laz", "file not found")


def test_vegetation_as_locations_with_low_poly_plants(street: Path, world: Path, tmp_path: Path) -> None:
    out = shutil.copytree(world, tmp_path / "out")
    changed = [f"--set={name}" for name in ("split.vegetation=locations", "backdrop.when=never", "roads.when=never")]
    with inline_steps():
        stdout_of(in_process("run", street, "--out", out, "--hold-out", 2, *SMALL, *changed))
    pages = list((out / "world").rglob("*_vegetation_*.png"))
    assert len(pages) == 1  # texture of the low-poly plants
    features = json.loads(next((out / "world").rglob("plants.geojson")).read_text(encoding="utf-8"))["features"]
    assert features and all(f["properties"]["height_m"] > 0 for f in features)


def test_user_edits_of_the_world_are_kept(street: Path, world: Path) -> None:
    sdf = next((world / "world").glob("*.sdf"))
    sdf.write_text(sdf.read_text(encoding="utf-8") + "<!-- my robot -->", encoding="utf-8")
    stdout_of(in_process("run", street, "--out", world, "--hold-out", 2, *SMALL))
    assert "my robot" in sdf.read_text(encoding="utf-8")
