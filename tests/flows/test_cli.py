"""The command line on a small street: worlds, reports, resuming, and bad input."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from scan2sim.pipeline.core.classes import GROUPS, group_of
from scan2sim.pipeline.core.types import Frame, Mesh, PointCloud
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import geotiff
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.services.monitoring.events.schema import Event
from tests.conftest import ROOT
from tests.fakes.broker import Broker
from tests.fakes.browser import chromium
from tests.fakes.gazebo.checker import check_world
from tests.flows.bus_events import read_events
from tests.flows.processes import processes
from tests.flows.tiny import tiny
from tests.waiting import until

NEXT_FRAME_DRAWN = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"
SMALL = [f"--set={name}" for name in (
    "unwrap.texel=0.1", "decimate.target=10000", "pictures.width=160", "pictures.compared=1")
]  # fmt: skip


def scan2sim(*arguments: object, timeout: float = 600) -> subprocess.CompletedProcess[str]:
    """Run `scan2sim` in a subprocess."""
    return subprocess.run(
        [sys.executable, "-m", "scan2sim.flows.cli", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=timeout,
        env=dict(os.environ, COLUMNS="200"),
    )


def stdout_of(result: subprocess.CompletedProcess[str]) -> str:
    """Standard output of a command that must succeed."""
    assert result.returncode == 0, result.stderr + result.stdout
    return result.stdout


def assert_fails(result: subprocess.CompletedProcess[str], code: int, *parts: str) -> None:
    """Assert that a command failed with an exit code and one message that contains all parts, without a traceback."""
    assert result.returncode == code, (result.returncode, result.stderr, result.stdout)
    for part in parts:
        assert part in result.stderr, result.stderr
    assert "Traceback" not in result.stderr + result.stdout
    assert len(result.stderr.strip().splitlines()) == 2, result.stderr


@pytest.fixture(scope="module")
def street(small_street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small street with a quarter of its points and half of its photos."""
    return tiny(small_street, tmp_path_factory.mktemp("street") / "tile", every=4, photos=4)


@pytest.fixture(scope="module")
def world(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the small street."""
    out = tmp_path_factory.mktemp("world")
    stdout_of(scan2sim("run", street, "--out", out, "--hold-out", 2, *SMALL))
    return out


def test_run_publishes_its_progress_on_the_bus(
    street: Path, world: Path, tmp_path: Path, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    out = shutil.copytree(world, tmp_path / "out")
    shutil.rmtree(out / "steps" / "preview")
    command = ("run", street, "--out", out, "--hold-out", 2, *SMALL, "--bus", broker.servers)
    stdout_of(scan2sim(*command))
    broker.kill()
    assert "nothing to do" in stdout_of(scan2sim(*command))
    broker.start()
    stdout_of(scan2sim(*command))  # also sends what the previous run couldn't, and what the broker has lost

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


def test_rasters_are_built_only_if_requested(street: Path, world: Path, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio", reason="rasterio isn't installed")
    out = shutil.copytree(world, tmp_path / "out")
    command = (street, "--out", out, "--hold-out", 2, *SMALL)
    assert "rasters" not in stdout_of(scan2sim("plan", *command))
    assert not (out / "rasters").exists()
    stdout_of(scan2sim("run", *command, "--set", "export.rasters=0.1"))
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
    stdout_of(scan2sim("run", *command))
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


@pytest.fixture
def damaged(street: Path, tmp_path: Path) -> Path:
    """A copy of the street to damage."""
    shutil.copytree(street, tmp_path / "tile")
    return tmp_path / "tile"


def edit(tile: Path, old: str, new: str, count: int = 1) -> None:
    text = (tile / "tile.toml").read_text(encoding="utf-8")
    assert old in text
    (tile / "tile.toml").write_text(text.replace(old, new, count), encoding="utf-8")


def test_unencodable_characters_are_printed_as_question_marks(tmp_path: Path) -> None:
    tile = tmp_path / "straße\u2026"
    shutil.copytree(ROOT / "data_samples" / "tile", tile)
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
    assert {name.split("_")[0] for name in textures} == {"terrain", "building", "vegetation", "backdrop"}


def test_second_run_does_nothing_and_a_deleted_texture_is_rebuilt(street: Path, world: Path) -> None:
    command = ("run", street, "--out", world, "--hold-out", 2, *SMALL)
    before = {p: p.stat().st_mtime_ns for p in (world / "steps").rglob("*/*") if p.is_file()}
    assert "nothing to do" in stdout_of(scan2sim(*command))
    assert before == {p: p.stat().st_mtime_ns for p in (world / "steps").rglob("*/*") if p.is_file()}
    next((world / "steps" / "texture.building").rglob("page_0.png")).unlink()
    plan = stdout_of(scan2sim("plan", *command[1:]))
    assert [line.split()[0] for line in plan.splitlines() if " yes " in line] == ["texture.building"]
    stdout_of(scan2sim(*command))
    after = {p: p.stat().st_mtime_ns for p in (world / "steps").rglob("*/*") if p.is_file()}
    assert {p.parts[-3] for p in before if before[p] != after.get(p)} <= {"texture.building"} | {
        p.parts[-3] for p in before if "texture.building" in str(p)
    }


def test_plan_lists_the_steps_affected_by_a_setting(street: Path, world: Path) -> None:
    text = stdout_of(
        scan2sim("plan", street, "--out", world, "--hold-out", 2, *SMALL, "--set", "trim.building.max_edge=0.3")
    )
    again = {line.split()[0] for line in text.splitlines() if " yes " in line}
    assert "trim.building" in again and "texture.terrain" in again  # buildings occlude the terrain
    assert not again & {"ingest", "poisson.building", "trim.terrain", "decimate.terrain"}


def test_inspect_summarizes_cloud_tile_mesh_and_world(street: Path, world: Path) -> None:
    assert "EPSG" in stdout_of(scan2sim("inspect", street / "cloud.laz"))
    assert "photos" in stdout_of(scan2sim("inspect", street))
    assert "triangles" in stdout_of(scan2sim("inspect", next((world / "world").rglob("terrain*.obj"))))
    assert "place" in stdout_of(scan2sim("inspect", world))
    assert_fails(scan2sim("inspect", street / "nothing.laz"), 3, "nothing.laz", "file not found")


def test_vegetation_as_locations_with_low_poly_plants(street: Path, world: Path, tmp_path: Path) -> None:
    out = shutil.copytree(world, tmp_path / "out")
    stdout_of(scan2sim("run", street, "--out", out, "--hold-out", 2, *SMALL, "--set", "split.vegetation=locations"))
    pages = list((out / "world").rglob("vegetation*.png"))
    assert len(pages) == 1  # texture of the low-poly plants
    features = json.loads(next((out / "world").rglob("plants.geojson")).read_text(encoding="utf-8"))["features"]
    assert features and all(f["properties"]["height_m"] > 0 for f in features)


def test_cloud_without_photos_colours_and_classes(street: Path, tmp_path: Path) -> None:
    frame = Frame("EPSG:32633", (500000.0, 5400000.0, 200.0))
    cloud = las.read(street / "cloud.laz", read_tile(street).frame)
    las.write(tmp_path / "plain.laz", PointCloud(frame, cloud.xyz))
    stdout_of(scan2sim("import", "las", tmp_path / "plain.laz", "--out", tmp_path / "tile"))
    stdout_of(scan2sim("run", tmp_path / "tile", "--out", tmp_path / "out", *SMALL))
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert report["texture"]["coverage"] == 0 and report["steps"]["segment"]["metrics"]["source"] == "shape"


def test_truncated_cloud_is_an_input_error(damaged: Path, tmp_path: Path) -> None:
    data = (damaged / "cloud.laz").read_bytes()
    (damaged / "cloud.laz").write_bytes(data[: len(data) // 2])
    assert_fails(scan2sim("run", damaged, "--out", tmp_path / "out"), 3, "cloud.laz", "Copy or export the file again")


def test_missing_crs_is_an_input_error(damaged: Path, tmp_path: Path) -> None:
    cloud = las.read(damaged / "cloud.laz", read_tile(damaged).frame)
    las.write(damaged / "cloud.laz", PointCloud(Frame(), cloud.xyz))
    text = (damaged / "tile.toml").read_text(encoding="utf-8")
    (damaged / "tile.toml").write_text(
        "\n".join(line for line in text.splitlines() if not line.startswith("crs")), encoding="utf-8"
    )
    assert_fails(scan2sim("run", damaged, "--out", tmp_path / "out"), 3, "cloud.laz", "no CRS", 'crs = "local"')


def test_clouds_with_different_crs_are_an_input_error(damaged: Path, tmp_path: Path) -> None:
    cloud = las.read(damaged / "cloud.laz", read_tile(damaged).frame)
    las.write(damaged / "other.laz", PointCloud(Frame("EPSG:2154", (600000.0, 6000000.0, 0.0)), cloud.xyz[:5000]))
    edit(damaged, '"cloud.laz"', '"cloud.laz", "other.laz"')
    edit(damaged, f'crs = "{cloud.frame.crs}"', "")
    assert_fails(scan2sim("run", damaged, "--out", tmp_path / "out"), 3, "other.laz", "EPSG:2154", "one CRS")


def test_photos_that_see_no_point_are_a_data_error(damaged: Path, tmp_path: Path) -> None:
    lines = (damaged / "tile.toml").read_text(encoding="utf-8").splitlines()
    inside = False
    for i, line in enumerate(lines):
        if line.startswith("position"):
            inside = True
        elif inside and line.strip(" ,").replace(".", "").replace("-", "").isdigit():
            lines[i] = "    12345.0,"
        elif line.startswith("]"):
            inside = False
        if line.startswith("position") and line.endswith("]"):
            lines[i], inside = "position = [12345.0, 12345.0, 12345.0]", False
    (damaged / "tile.toml").write_text("\n".join(lines), encoding="utf-8")
    assert_fails(
        scan2sim("run", damaged, "--out", tmp_path / "out", *SMALL),
        4,
        "photos sees a point of the cloud",
        "CRS, units and axes",
    )


def test_missing_and_unreadable_photos_are_skipped_with_a_warning(damaged: Path, world: Path, tmp_path: Path) -> None:
    photos = sorted((damaged / "photos").rglob("*.jpg"))
    photos[0].unlink()
    photos[1].write_bytes(b"no photo")
    data = photos[2].read_bytes()
    photos[2].write_bytes(data[: len(data) // 3])
    shutil.copytree(world, tmp_path / "out")
    stdout_of(scan2sim("run", damaged, "--out", tmp_path / "out", *SMALL))
    findings = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))["findings"]
    for photo in photos[:3]:
        assert any(photo.name in finding["text"] for finding in findings), findings


@pytest.mark.slow
def test_masked_pixels_are_not_used(damaged: Path, world: Path, tmp_path: Path) -> None:
    (damaged / "masks").mkdir()
    text, out = (damaged / "tile.toml").read_text(encoding="utf-8"), []
    for line in text.splitlines():
        out.append(line)
        if line.startswith("file ="):
            name = Path(line.split('"')[1]).name
            width, height = Image.open(damaged / "photos" / name).size
            Image.new("L", (width, height), 0).save(damaged / "masks" / name, quality=100)
            out.append(f'mask = "masks/{name}"')
    (damaged / "tile.toml").write_text("\n".join(out), encoding="utf-8")
    shutil.copytree(world, tmp_path / "out")
    stdout_of(scan2sim("run", damaged, "--out", tmp_path / "out", *SMALL))
    assert json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))["texture"]["coverage"] == 0


def test_folder_that_is_not_a_tile_is_not_overwritten(street: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    result = scan2sim("import", "las", street / "cloud.laz", "--out", tmp_path, "--overwrite")
    assert_fails(result, 2, "is not a tile")
    assert (tmp_path / "notes.txt").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize("options", [["--jobs", "-1"], ["--set", "ingest.unit=2.0"], ["--set", "split.roof.x=1"]])
def test_invalid_options_are_setting_errors(street: Path, tmp_path: Path, options: list[str]) -> None:
    assert scan2sim("run", street, "--out", tmp_path / "out", *options).returncode == 2


def test_user_edits_of_the_world_are_kept(street: Path, world: Path) -> None:
    sdf = next((world / "world").glob("*.sdf"))
    sdf.write_text(sdf.read_text(encoding="utf-8") + "<!-- my robot -->", encoding="utf-8")
    stdout_of(scan2sim("run", street, "--out", world, "--hold-out", 2, *SMALL))
    assert "my robot" in sdf.read_text(encoding="utf-8")


def test_missing_photo_folder_is_an_input_error(damaged: Path, tmp_path: Path) -> None:
    shutil.rmtree(damaged / "photos")
    assert_fails(scan2sim("run", damaged, "--out", tmp_path / "out", *SMALL), 3, "no photo of the tile can be read")


def test_invalid_poses_are_input_errors(damaged: Path, tmp_path: Path) -> None:
    text = (damaged / "tile.toml").read_text(encoding="utf-8")
    head, tail = text.split("rotation", 1)
    (damaged / "tile.toml").write_text(
        head + "rotation = [[1,0,0],[0,2,0],[0,0,1]]\n#" + _one_line(tail), encoding="utf-8"
    )
    assert_fails(scan2sim("run", damaged, "--out", tmp_path / "out"), 3, "tile.toml", "is not a rotation matrix")
    head, tail = text.split("position", 1)
    (damaged / "tile.toml").write_text(head + "position = [nan, 0.0, 0.0]\n#" + _one_line(tail), encoding="utf-8")
    assert_fails(scan2sim("run", damaged, "--out", tmp_path / "out"), 3, "tile.toml", "NaN")


def _one_line(rest: str) -> str:
    """The rest of a TOML file with the value at its start joined to one line, to be commented out."""
    depth, end = 0, rest.index("[")
    while depth > 0 or rest[end] == "[":
        depth += {"[": 1, "]": -1}.get(rest[end], 0)
        end += 1
    return rest[:end].replace("\n", " ") + rest[end:]


def flip(path: Path, *, hide: bool = False) -> None:
    """Flip a bit in the middle of a file; with `hide`, restore its modification time."""
    stat, data = path.stat(), bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    if hide:
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def test_damaged_results_are_reported_and_rebuilt(street: Path, world: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(world, out, symlinks=True)
    options = ["run", street, "--out", out, "--hold-out", 2, *SMALL]
    assert "are intact" in stdout_of(scan2sim("verify", out))
    assert "nothing to do" in stdout_of(scan2sim(*options))

    (page,) = list((out / "world").rglob("*building*.png"))[:1]
    (sdf,) = (out / "world").glob("*.sdf")
    whole = page.read_bytes(), sdf.read_bytes()
    flip(page)
    flip(sdf)  # can't be distinguished from an edit
    changed = f"{sdf} was edited and is kept"
    checked = scan2sim("verify", out)
    assert checked.returncode == 5 and changed in checked.stdout and "1 of" in checked.stderr
    assert changed in stdout_of(scan2sim(*options))
    assert page.read_bytes() == whole[0] and sdf.read_bytes() != whole[1]
    assert changed in stdout_of(scan2sim(*options))
    sdf.unlink()
    stdout_of(scan2sim(*options))
    made = next((out / "steps" / "export").rglob(sdf.name))
    assert (page.read_bytes(), sdf.read_bytes()) == (whole[0], made.read_bytes())

    kept = next((out / "steps" / "decimate.terrain").glob("*/mesh.npz"))
    whole = kept.read_bytes(), page.read_bytes()
    flip(kept, hide=True)
    page.unlink()
    page.write_bytes(whole[1])
    flip(page, hide=True)
    result = scan2sim("verify", out)
    assert result.returncode == 5 and "Traceback" not in result.stderr
    assert "decimate.terrain" in result.stdout and page.name in result.stdout
    printed = stdout_of(scan2sim(*options))
    assert (kept.read_bytes(), page.read_bytes()) == whole
    assert [line.split()[1] for line in printed.splitlines() if line.startswith("✓")] == ["decimate.terrain"]
    stdout_of(scan2sim("verify", out))
    assert_fails(scan2sim("verify", tmp_path), 3, "contains no results")


def test_bad_input_keeps_earlier_results(street: Path, world: Path, tmp_path: Path) -> None:
    shutil.copytree(world, tmp_path / "out", symlinks=True)
    shutil.copytree(street, tmp_path / "tile")
    data = (tmp_path / "tile" / "cloud.laz").read_bytes()
    (tmp_path / "tile" / "cloud.laz").write_bytes(data[:-1000])
    before = {p.relative_to(tmp_path): p.stat().st_size for p in (tmp_path / "out" / "world").rglob("*") if p.is_file()}
    assert scan2sim("run", tmp_path / "tile", "--out", tmp_path / "out", *SMALL).returncode == 3
    assert before == {
        p.relative_to(tmp_path): p.stat().st_size for p in (tmp_path / "out" / "world").rglob("*") if p.is_file()
    }
    assert list((tmp_path / "out" / "steps" / "poisson.terrain").glob("*/mesh.npz"))


@pytest.mark.parametrize("megabytes", [6, pytest.param(40, marks=pytest.mark.slow)])
def test_full_disk_is_a_space_error(street: Path, tmp_path: Path, megabytes: int) -> None:
    mount = tmp_path / "small_disk"
    mount.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(mount)], capture_output=True
    ).returncode:
        pytest.skip("a small file system can't be mounted here (not root)")
    try:
        assert_fails(scan2sim("run", street, "--out", mount / "out", *SMALL), 6, "no space left", "Free some space")
    finally:
        subprocess.run(["umount", str(mount)], check=True)


def test_ctrl_c_prints_a_message_and_releases_the_lock(street: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "scan2sim.flows.cli", "run", str(street), "--out", str(tmp_path / "out"), *SMALL]
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    started = tmp_path / "out" / "steps" / "poisson.terrain"
    until(lambda: child.poll() is not None or started.exists(), 240, what="the step")
    child.send_signal(signal.SIGINT)
    _, message = child.communicate()
    assert child.returncode == 130 and "finished steps are kept" in message and "Traceback" not in message
    assert_fails(
        scan2sim("run", street, "--out", tmp_path / "out", "--from", "roof"), 2, "no such step"
    )  # not BusyError


@pytest.mark.parametrize(
    "step",
    [
        "poisson.terrain",
        *(pytest.param(s, marks=pytest.mark.slow) for s in ("ingest", "unwrap.building", "texture.terrain", "export")),
    ],
)
def test_resume_after_sigkill_gives_identical_textures(
    street: Path, world: Path, tmp_path: Path, step: str
) -> None:  # fmt: skip
    arguments = ["run", str(street), "--out", str(tmp_path / "out"), "--hold-out", "2", *SMALL]
    command = [sys.executable, "-m", "scan2sim.flows.cli", *arguments]
    own = {"RUN_TO_KILL": str(tmp_path)}
    child = subprocess.Popen(
        command, cwd=ROOT, env=os.environ | own, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    folder = tmp_path / "out" / "steps" / step
    until(lambda: child.poll() is not None or folder.exists(), 240, what="the step")
    child.send_signal(signal.SIGKILL)
    child.wait()
    until(lambda: not processes("RUN_TO_KILL", str(tmp_path)), what="the end of all its processes")
    finished = {p.parent.name for p in (tmp_path / "out" / "steps").glob("*/*") if not p.name.startswith(".tmp-")}
    out = stdout_of(scan2sim(*arguments))
    again = {line.split()[1] for line in out.splitlines() if line.startswith("✓")}
    assert not finished & again, "finished steps are not repeated"
    assert (tmp_path / "out" / "report.html").is_file()
    assert not list((tmp_path / "out" / "steps").rglob(".tmp-*"))
    for path in sorted((world / "world").rglob("*.png")):
        twin = tmp_path / "out" / path.relative_to(world)
        assert np.array_equal(np.frombuffer(path.read_bytes(), np.uint8), np.frombuffer(twin.read_bytes(), np.uint8)), (
            path
        )
