"""The command as a user types it, on a small street: worlds, reports, resuming, and bad input."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scan2sim.pipeline.core.classes import GROUPS, group_of
from scan2sim.pipeline.core.types import Frame, Mesh, PointCloud
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.geodata import geotiff
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.services import kafka
from tests.browser import chromium
from tests.conftest import ROOT
from tests.fakes.broker import Broker
from tests.gazebo.checker import check_world

SHOWN = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"
SMALL = ["--set", "unwrap.texel=0.05", "--set", "decimate.target=10000"]


def scan2sim(*arguments: object, timeout: float = 300) -> subprocess.CompletedProcess[str]:
    """Run the command."""
    return subprocess.run(
        [sys.executable, "-m", "scan2sim.flows.cli", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=timeout,
        env=dict(os.environ, COLUMNS="200"),
    )


def good(result: subprocess.CompletedProcess[str]) -> str:
    assert result.returncode == 0, result.stderr + result.stdout
    return result.stdout


def bad(result: subprocess.CompletedProcess[str], code: int, *parts: str) -> None:
    """The command failed with an exit code and one message that holds all parts, without a traceback."""
    assert result.returncode == code, (result.returncode, result.stderr, result.stdout)
    for part in parts:
        assert part in result.stderr, result.stderr
    assert "Traceback" not in result.stderr + result.stdout
    assert len(result.stderr.strip().splitlines()) == 2, result.stderr


@pytest.fixture(scope="module")
def street(small_street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the small street that tests may damage copies of."""
    copy = tmp_path_factory.mktemp("street") / "tile"
    shutil.copytree(small_street, copy)
    return copy


@pytest.fixture(scope="module")
def world(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the small street."""
    out = tmp_path_factory.mktemp("world")
    good(scan2sim("run", street, "--out", out, "--hold-out", 4, *SMALL))
    return out


def test_the_bus_is_told_of_a_run(
    street: Path, world: Path, tmp_path: Path, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    out = shutil.copytree(world, tmp_path / "out")
    shutil.rmtree(out / "steps" / "preview")
    command = ("run", street, "--out", out, "--hold-out", 4, *SMALL, "--bus", broker.servers)
    good(scan2sim(*command))
    broker.kill()
    began = time.monotonic()
    assert "nothing to do" in good(scan2sim(*command))
    assert time.monotonic() - began < 30
    broker.start()
    good(scan2sim(*command))  # sends what the one before couldn't, and what the broker has forgotten
    steps, runs = defaultdict[str, set[str]](set), list[tuple[str, int, int]]()
    for told in kafka.read(broker.servers, "bus_events", group="test", from_start=True, wait=0.5):
        event = json.loads(told or "{}")
        if event.get("kind") == "step":
            steps[event["body"]["step"]].add(event["body"]["state"])
        elif event.get("kind") == "run" and event["body"]["state"] == "done":
            runs.append((event["body"]["source"], event["body"]["kept"], event["body"]["done"]))
        if len(runs) == 3 or time.monotonic() - began > 90:
            break
    count = len(steps)
    # each run's events are in order, runs may be read in any: a broker parts them
    assert sorted(runs) == [(str(street), count - 1, 1), (str(street), count, 0), (str(street), count, 0)]
    assert all("kept" in states for states in steps.values()) and "preview" in steps


def test_rasters_are_made_where_they_are_asked_for(street: Path, world: Path, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio", reason="rasterio isn't installed")
    out = shutil.copytree(world, tmp_path / "out")
    command = (street, "--out", out, "--hold-out", 4, *SMALL)
    assert "rasters" not in good(scan2sim("plan", *command))
    assert not (out / "rasters").exists()
    good(scan2sim("run", *command, "--set", "export.rasters=0.1"))
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
    good(scan2sim("run", *command))
    assert not (out / "rasters").exists()  # they are of another run than the world


def test_the_report_has_the_world_to_turn_and_walk_through(world: Path, tmp_path: Path) -> None:
    def eye() -> np.ndarray:
        return np.array(page.value("document.querySelector('output').value").split(), float)

    with chromium(tmp_path) as page:
        page.open(world / "report.html")
        page.click("[data-open]")
        page.until("document.querySelector('header').dataset.state == 'open' && document.querySelector('output').value")
        street, start = page.picture()[50:450], eye()
        assert street.std() > 15, "the canvas shows more than one colour"
        while np.linalg.norm((eye() - start)[:2]) < 0.3:  # frames are few without a GPU
            page.key("KeyW", "w", 0.3)
        assert abs((eye() - start)[2]) < 0.5, "it walks on the ground"
        page.drag((400, 300), (700, 300))
        page.until(SHOWN)
        assert np.abs(page.picture()[50:450].astype(int) - street).mean() > 10
        page.click("[data-to=turn]")
        page.until(f"Number(document.querySelector('output').value.split('  ')[2]) > {start[2] + 5}")
        assert page.errors == []
        page.open(world / "report.html", phone=True, dark=True)
        page.click("[data-open]")
        page.until("document.querySelector('header').dataset.state == 'open'")
        page.until("document.querySelector('output').value")
        street, start = page.picture()[50:560], eye()
        page.touch("canvas", 0.3, across=120)
        page.until(SHOWN)
        assert np.abs(page.picture()[50:560].astype(int) - street).mean() > 2 and (eye() == start).all()
        while np.linalg.norm((eye() - start)[:2]) < 0.3:
            page.touch(".pad [data-key=KeyW]", 0.3)
        page.open(Path(shutil.copy(world / "report.html", tmp_path)))  # without what lies beside it
        page.click("[data-open]")
        page.until("document.querySelector('[role=status]').textContent.includes(\"isn't beside this page\")")


def test_without_webgl_the_report_shows_the_picture_and_says_why(world: Path, tmp_path: Path) -> None:
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


def test_a_terminal_that_is_not_utf8_gets_question_marks(tmp_path: Path) -> None:
    tile = tmp_path / "straße\u2026"
    shutil.copytree(ROOT / "data_samples" / "tile", tile)
    command = [sys.executable, "-m", "scan2sim.flows.cli", "inspect", str(tile)]
    run = subprocess.run(command, env=os.environ | {"PYTHONIOENCODING": "latin-1"}, cwd=ROOT, capture_output=True)
    assert run.returncode == 0, run.stderr
    assert "straße?" in run.stdout.decode("latin-1").replace("\n", "") and b"Traceback" not in run.stderr


def test_version_and_help() -> None:
    assert good(scan2sim("--version")).startswith("scan2sim 0.")
    text = good(scan2sim("--help"))
    assert all(command in text for command in ("run", "plan", "inspect", "import", "sample"))


def test_a_street_becomes_a_world_with_its_report(world: Path) -> None:
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
    assert page.count("data:image/") >= 8 and "http" not in page.split("<main>")[1]


def test_gazebo_loads_the_world_and_a_box_rests_on_its_road(street: Path, world: Path) -> None:
    tile = read_tile(street)
    assert tile.trajectory is not None
    x, y, z = tile.trajectory.positions[len(tile.trajectory.times) // 4]
    seen = check_world(next((world / "world").glob("*.sdf")), ("box", (float(x), float(y), float(z))))
    (box,) = seen["bodies"]
    assert box["speed"] < 0.1
    assert abs(box["rest"][2] - (z - 2.0 + 0.2)) < 0.15, "the scanner rides 2 m above the road; the box is 40 cm high"
    textures = {texture for mesh in seen["meshes"] for texture in mesh["textures"]}
    assert {name.split("_")[0] for name in textures} == {"terrain", "building", "vegetation"}


def test_running_again_does_nothing_and_a_deleted_page_comes_back(street: Path, world: Path) -> None:
    command = ("run", street, "--out", world, "--hold-out", 4, *SMALL)
    before = {p: p.stat().st_mtime_ns for p in (world / "steps").rglob("*") if p.is_file()}
    assert "nothing to do" in good(scan2sim(*command))
    assert before == {p: p.stat().st_mtime_ns for p in (world / "steps").rglob("*") if p.is_file()}
    next((world / "steps" / "texture.building").rglob("page_0.png")).unlink()
    plan = good(scan2sim("plan", *command[1:]))
    assert [line.split()[0] for line in plan.splitlines() if " yes " in line] == ["texture.building"]
    good(scan2sim(*command))
    after = {p: p.stat().st_mtime_ns for p in (world / "steps").rglob("*") if p.is_file()}
    assert {p.parts[-3] for p in before if before[p] != after.get(p)} <= {"texture.building"} | {
        p.parts[-3] for p in before if "texture.building" in str(p)
    }


def test_plan_says_what_a_setting_changes(street: Path, world: Path) -> None:
    text = good(
        scan2sim("plan", street, "--out", world, "--hold-out", 4, *SMALL, "--set", "trim.building.max_edge=0.3")
    )
    again = {line.split()[0] for line in text.splitlines() if " yes " in line}
    assert "trim.building" in again and "texture.terrain" in again  # buildings hide what is behind them
    assert not again & {"ingest", "poisson.building", "trim.terrain", "decimate.terrain"}


def test_inspect_tells_of_cloud_tile_mesh_and_world(street: Path, world: Path) -> None:
    assert "EPSG" in good(scan2sim("inspect", street / "cloud.laz"))
    assert "photos" in good(scan2sim("inspect", street))
    assert "triangles" in good(scan2sim("inspect", next((world / "world").rglob("terrain*.obj"))))
    assert "place" in good(scan2sim("inspect", world))
    bad(scan2sim("inspect", street / "nothing.laz"), 3, "nothing.laz", "is missing")


def test_plants_as_places(street: Path, world: Path, tmp_path: Path) -> None:
    out = shutil.copytree(world, tmp_path / "out")
    good(scan2sim("run", street, "--out", out, "--hold-out", 4, *SMALL, "--set", "split.vegetation=locations"))
    pages = list((out / "world").rglob("vegetation*.png"))
    assert len(pages) == 1  # of the low-poly plants that stand there
    features = json.loads(next((out / "world").rglob("plants.geojson")).read_text(encoding="utf-8"))["features"]
    assert features and all(f["properties"]["height_m"] > 0 for f in features)


def test_a_cloud_alone_without_colours_or_classes(street: Path, tmp_path: Path) -> None:
    frame = Frame("EPSG:32633", (500000.0, 5400000.0, 200.0))
    cloud = las.read(street / "cloud.laz", read_tile(street).frame)
    las.write(tmp_path / "plain.laz", PointCloud(frame, cloud.xyz))
    good(scan2sim("import", "las", tmp_path / "plain.laz", "--out", tmp_path / "tile"))
    good(scan2sim("run", tmp_path / "tile", "--out", tmp_path / "out", *SMALL))
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert report["texture"]["coverage"] == 0 and report["steps"]["segment"]["facts"]["source"] == "shape"


def test_truncated_cloud(damaged: Path, tmp_path: Path) -> None:
    data = (damaged / "cloud.laz").read_bytes()
    (damaged / "cloud.laz").write_bytes(data[: len(data) // 2])
    bad(scan2sim("run", damaged, "--out", tmp_path / "out"), 3, "cloud.laz", "Copy it again")


def test_no_crs(damaged: Path, tmp_path: Path) -> None:
    cloud = las.read(damaged / "cloud.laz", read_tile(damaged).frame)
    las.write(damaged / "cloud.laz", PointCloud(Frame(), cloud.xyz))
    text = (damaged / "tile.toml").read_text(encoding="utf-8")
    (damaged / "tile.toml").write_text(
        "\n".join(line for line in text.splitlines() if not line.startswith("crs")), encoding="utf-8"
    )
    bad(scan2sim("run", damaged, "--out", tmp_path / "out"), 3, "cloud.laz", "no CRS", 'crs = "local"')


def test_two_crs(damaged: Path, tmp_path: Path) -> None:
    cloud = las.read(damaged / "cloud.laz", read_tile(damaged).frame)
    las.write(damaged / "other.laz", PointCloud(Frame("EPSG:2154", (600000.0, 6000000.0, 0.0)), cloud.xyz[:5000]))
    edit(damaged, '"cloud.laz"', '"cloud.laz", "other.laz"')
    bad(scan2sim("run", damaged, "--out", tmp_path / "out"), 3, "other.laz", "EPSG:2154", "one CRS")


def test_cloud_and_cameras_that_never_meet(damaged: Path, tmp_path: Path) -> None:
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
    bad(scan2sim("run", damaged, "--out", tmp_path / "out", *SMALL), 4, "never meet", "CRS, units and axes")


def test_missing_and_unreadable_photos_are_skipped(damaged: Path, world: Path, tmp_path: Path) -> None:
    photos = sorted((damaged / "photos").rglob("*.jpg"))
    photos[0].unlink()
    photos[1].write_bytes(b"no photo")
    data = photos[2].read_bytes()
    photos[2].write_bytes(data[: len(data) // 3])
    shutil.copytree(world, tmp_path / "out")
    said = good(scan2sim("run", damaged, "--out", tmp_path / "out", *SMALL))
    for photo in photos[:3]:
        assert photo.name in said, said


@pytest.mark.slow
def test_masks_named_as_their_photos_keep_pixels_out(damaged: Path, world: Path, tmp_path: Path) -> None:
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
    good(scan2sim("run", damaged, "--out", tmp_path / "out", *SMALL))
    assert json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))["texture"]["coverage"] == 0


def test_a_folder_that_is_no_tile_is_not_overwritten(street: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    result = scan2sim("import", "las", street / "cloud.laz", "--out", tmp_path, "--overwrite")
    bad(result, 2, "is no tile")
    assert (tmp_path / "notes.txt").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize("options", [["--jobs", "-1"], ["--set", "ingest.unit=2.0"], ["--set", "split.roof.x=1"]])
def test_options_that_make_no_sense(street: Path, tmp_path: Path, options: list[str]) -> None:
    assert scan2sim("run", street, "--out", tmp_path / "out", *options).returncode == 2


def test_a_users_edit_of_the_world_stays(street: Path, world: Path) -> None:
    sdf = next((world / "world").glob("*.sdf"))
    sdf.write_text(sdf.read_text(encoding="utf-8") + "<!-- my robot -->", encoding="utf-8")
    good(scan2sim("run", street, "--out", world, "--hold-out", 4, *SMALL))
    assert "my robot" in sdf.read_text(encoding="utf-8")


def test_all_photos_gone(damaged: Path, tmp_path: Path) -> None:
    shutil.rmtree(damaged / "photos")
    bad(scan2sim("run", damaged, "--out", tmp_path / "out", *SMALL), 3, "no photo of the tile can be read")


def test_nan_pose_and_no_rotation(damaged: Path, tmp_path: Path) -> None:
    text = (damaged / "tile.toml").read_text(encoding="utf-8")
    head, tail = text.split("rotation", 1)
    (damaged / "tile.toml").write_text(
        head + "rotation = [[1,0,0],[0,2,0],[0,0,1]]\n#" + _one_line(tail), encoding="utf-8"
    )
    bad(scan2sim("run", damaged, "--out", tmp_path / "out"), 3, "tile.toml", "is no rotation")
    head, tail = text.split("position", 1)
    (damaged / "tile.toml").write_text(head + "position = [nan, 0.0, 0.0]\n#" + _one_line(tail), encoding="utf-8")
    bad(scan2sim("run", damaged, "--out", tmp_path / "out"), 3, "tile.toml", "NaN")


def _one_line(rest: str) -> str:
    """A TOML value's remainder with the value commented out, whether on one line or several."""
    depth, end = 0, rest.index("[")
    while depth > 0 or rest[end] == "[":
        depth += {"[": 1, "]": -1}.get(rest[end], 0)
        end += 1
    return rest[:end].replace("\n", " ") + rest[end:]


def flip(path: Path, *, hide: bool = False) -> None:
    """Change a byte in the middle of a file, and leave its time as it was if it is to be hidden."""
    stat, data = path.stat(), bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    if hide:
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def test_damage_is_noticed_told_and_mended(street: Path, world: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(world, out, symlinks=True)
    options = ["run", street, "--out", out, "--hold-out", 4, *SMALL]
    assert "are as they were made" in good(scan2sim("verify", out))
    assert "nothing to do" in good(scan2sim(*options))

    (page,) = list((out / "world").rglob("*building*.png"))[:1]
    (sdf,) = (out / "world").glob("*.sdf")
    whole = page.read_bytes(), sdf.read_bytes()
    flip(page)
    flip(sdf)  # an edit, for all that can be known
    changed = f"{sdf} was changed since it was made, and stays so"
    checked = scan2sim("verify", out)
    assert checked.returncode == 5 and changed in checked.stdout and "1 of" in checked.stderr
    assert changed in good(scan2sim(*options))
    assert page.read_bytes() == whole[0] and sdf.read_bytes() != whole[1]
    assert changed in good(scan2sim(*options))
    sdf.unlink()
    good(scan2sim(*options))
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
    printed = good(scan2sim(*options))
    assert (kept.read_bytes(), page.read_bytes()) == whole
    assert [line.split()[1] for line in printed.splitlines() if line.startswith("✓")] == ["decimate.terrain"]
    good(scan2sim("verify", out))
    bad(scan2sim("verify", tmp_path), 3, "holds no results")


def test_bad_input_leaves_earlier_results(street: Path, world: Path, tmp_path: Path) -> None:
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
def test_a_full_disk(street: Path, tmp_path: Path, megabytes: int) -> None:
    mount = tmp_path / "small_disk"
    mount.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(mount)], capture_output=True
    ).returncode:
        pytest.skip("a small file system can't be mounted here (not root)")
    try:
        bad(scan2sim("run", street, "--out", mount / "out", *SMALL), 6, "no space left", "Free some space")
    finally:
        subprocess.run(["umount", str(mount)], check=True)


def test_ctrl_c_ends_with_a_message_and_frees_the_folder(street: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "scan2sim.flows.cli", "run", str(street), "--out", str(tmp_path / "out"), *SMALL]
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while child.poll() is None and not (tmp_path / "out" / "steps" / "poisson.terrain").exists():
        time.sleep(0.02)
    child.send_signal(signal.SIGINT)
    _, message = child.communicate(timeout=120)
    assert child.returncode == 130 and "what was finished is kept" in message and "Traceback" not in message
    bad(scan2sim("run", street, "--out", tmp_path / "out", "--from", "roof"), 2, "no such step")  # not locked


@pytest.mark.parametrize(
    "step",
    [
        "poisson.terrain",
        *(pytest.param(s, marks=pytest.mark.slow) for s in ("ingest", "unwrap.building", "texture.terrain", "export")),
    ],
)
def test_kill_9_at_any_step_then_resume_gives_the_same_to_the_last_bit(
    street: Path, world: Path, tmp_path: Path, step: str
) -> None:  # fmt: skip
    arguments = ["run", str(street), "--out", str(tmp_path / "out"), "--hold-out", "4", *SMALL]
    command = [sys.executable, "-m", "scan2sim.flows.cli", *arguments]
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    folder = tmp_path / "out" / "steps" / step
    while child.poll() is None and not folder.exists():
        time.sleep(0.02)
    child.send_signal(signal.SIGKILL)
    child.wait()
    time.sleep(1)
    finished = {p.parent.name for p in (tmp_path / "out" / "steps").glob("*/*") if not p.name.startswith(".tmp-")}
    out = good(scan2sim(*arguments))
    again = {line.split()[1] for line in out.splitlines() if line.startswith("✓")}
    assert not finished & again, "what was finished is kept"
    assert (tmp_path / "out" / "report.html").is_file()
    assert not list((tmp_path / "out" / "steps").rglob(".tmp-*"))
    for path in sorted((world / "world").rglob("*.png")):
        twin = tmp_path / "out" / path.relative_to(world)
        assert np.array_equal(np.frombuffer(path.read_bytes(), np.uint8), np.frombuffer(twin.read_bytes(), np.uint8)), (
            path
        )
