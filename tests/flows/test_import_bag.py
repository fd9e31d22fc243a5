"""`scan2sim import bag`, `scan2sim inspect` of bags, and drives with a bag."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from scan2sim.flows.cli import app
from scan2sim.flows.commands import display
from scan2sim.flows.commands.drive import plan_drive
from scan2sim.flows.pipelines.bag import BagSource, build_graph
from scan2sim.flows.pipelines.graph import Task
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.images.image import read_rgb
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.pose_check.conventions import AXES
from tests.fakes.bags import BagFile, bag_file, records
from tests.flows.inline_steps import inline_steps
from tests.flows.test_prepare import drive, survey_of
from tests.pipeline.importers.bag.test_unpack import (
    CAMERA,
    SWEEPS,
    T_BASE_LIDAR,
    T_LIDAR_CAMERA,
    XYZ,
    Writer,
    base,
    camera,
    lidar_link,
    odometry,
    points,
    poor_gps,
    tf,
    urdf,
    write,
)
from tests.present import present


@pytest.fixture(autouse=True)
def _wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(display.console, "_width", 200)  # undoing `width` would fix it at its present value


@pytest.fixture(autouse=True)
def _inline_steps() -> Iterator[None]:
    with inline_steps():
        yield


def command(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def test_import_makes_a_tile_with_cloud_photos_and_path(tmp_path: Path) -> None:
    path, out = write(tmp_path / "bag"), tmp_path / "tile"
    result = command("import", "bag", path, "--out", out, "--deskew", "none", "--min-range", 0)
    assert result.exit_code == 0 and f"{SWEEPS} sweeps and {SWEEPS} photos in 0.7 s; poses by tf" in result.output
    tile = read_tile(out)
    xyz = tile.frame.to_crs(clouds.read(tile.clouds[0], tile.frame).xyz)
    expected = [(base(k) @ T_BASE_LIDAR) @ np.column_stack([XYZ + 0.1 * k, np.ones(len(XYZ))]).T for k in range(SWEEPS)]
    assert np.abs(xyz - np.concatenate([one[:3].T for one in expected])).max() < 2e-3
    assert len(tile.views) == SWEEPS and all(view.camera == CAMERA for view in tile.views)
    first = tile.views[0].T_world_cam
    assert np.allclose(tile.frame.to_crs(first[:3, 3]), (T_BASE_LIDAR @ T_LIDAR_CAMERA)[:3, 3], atol=1e-5)
    assert tile.trajectory is not None and len(tile.trajectory) == SWEEPS

    before = (out / "tile.toml").read_bytes()
    for bad, error in ((tmp_path / "none.bag", InputError), (tmp_path / "bag", SettingError)):
        failed = command("import", "bag", bad, "--out", out, "--lidar", "/nothing", "--overwrite")
        assert isinstance(failed.exception, error)
    assert (out / "tile.toml").read_bytes() == before


def rear(bag: BagFile, k: int, time: float) -> None:
    camera(bag, k, time)
    bag.image("/rear/image_raw", time, "rear", np.full((20, 30), 60, np.uint8), "mono8")
    bag.camera_info("/rear/camera_info", time, "rear", CAMERA.resized(30, 20))
    if k == 0:
        bag.transforms("/tf_static", time, [("base", "rear", np.eye(4), time)])


def test_conventions_of_the_extrinsics_apply_to_the_cameras_of_a_bag(tmp_path: Path) -> None:
    path, out = write(tmp_path / "bag"), tmp_path / "tile"
    words = ("import", "bag", path, "--out", out, "--deskew", "none", "--min-range", 0)
    result = command(*words, "--camera-axes", "ros", "--invert-extrinsics")
    assert result.exit_code == 0, result.output
    tile = read_tile(out)
    expected = base(0) @ T_BASE_LIDAR @ np.linalg.inv(T_LIDAR_CAMERA)
    expected[:3, :3] = expected[:3, :3] @ AXES["ros"]
    expected[:3, 3] -= tile.frame.origin
    assert np.allclose(tile.views[0].T_world_cam, expected, atol=1e-5)


def test_each_camera_has_its_mask_of_the_vehicle(tmp_path: Path) -> None:
    path, masks = write(tmp_path / "bag", "mcap", tf, rear, points), tmp_path / "masks"
    masks.mkdir()
    mask = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    mask[20:] = 0
    cv2.imwrite(str(masks / "front.png"), mask)
    words = ("import", "bag", path, "--out", tmp_path / "tile", "--overwrite", "--deskew", "none", "--min-range", 0)
    result = command(*words, "--mask", masks)
    assert result.exit_code == 0, result.output
    own = {view.photo.parent.name: view.mask for view in read_tile(tmp_path / "tile").views}
    assert own["rear"] is None and np.array_equal(read_rgb(present(own["front"]))[..., 0], mask)
    alone = command(*words, "--camera", "/front/image_raw", "--mask", masks / "front.png")
    assert alone.exit_code == 0, alone.output
    assert all(view.mask is not None for view in read_tile(tmp_path / "tile").views)
    for bad, text in ((masks / "front.png", "one mask for several cameras"), (tmp_path / "bag", "has the masks none")):
        assert text in str(command(*words, "--mask", bad).exception)
    without = command(*words, "--camera", "none", "--mask", masks)
    assert isinstance(without.exception, SettingError) and "--mask" in str(without.exception)


def test_photos_of_several_cameras_and_the_vehicle_in_the_sweeps(tmp_path: Path) -> None:
    out = tmp_path / "tile"
    box = (-5, -5, -30, 5, 5, 30)
    words = ("--out", out, "--vehicle-box", *box, "--camera", "/rear/image_raw", "--camera", "/front/image_raw")
    result = command("import", "bag", write(tmp_path / "a.bag", "ros1", tf, rear, points), *words)
    assert result.exit_code == 0, result.output
    tile = read_tile(out)
    assert {view.camera.width for view in tile.views} == {30, 40} and len(tile.views) == 2 * SWEEPS
    assert {view.photo.parent.name for view in tile.views} == {"front", "rear"}
    inside = [(np.abs(XYZ + np.float32(0.1 * k))[:, :2] < 5).all(axis=1).sum() for k in range(SWEEPS)]
    assert sum(clouds.read_header(cloud).count for cloud in tile.clouds) <= SWEEPS * len(XYZ) - sum(inside)


def test_inspect_lists_topics_and_their_use(tmp_path: Path) -> None:
    def late(bag: BagFile, k: int, time: float) -> None:
        points(bag, k, time if k < 5 else time + 2)

    for path in (
        write(tmp_path / "a.bag", "ros1", tf, camera, late),
        write(tmp_path / "b", "sqlite3", tf, camera, late),
    ):
        text = command("inspect", path).output
        kind = "ROS 1" if path.suffix else "ROS 2"
        assert f"{kind} bag: {path}" in text and "2023-11-14 22:13:20 UTC" in text
        row = next(line for line in text.splitlines() if line.startswith("/points"))
        assert row.split()[:4] == ["/points", "PointCloud2", "8", "10.0"]
        assert "0.0 - 2.7" in row and "1, longest 2.1 s" in row and "sweeps; frame lidar" in row


def test_inspect_says_what_an_import_would_miss(tmp_path: Path) -> None:
    text = command("inspect", write(tmp_path / "bag", "mcap", tf, camera, points, static=False)).output
    assert "import bag` would stop" in text and "no static transform between the frames 'camera' and 'lidar'" in text


def test_a_urdf_completes_the_transforms(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", "mcap", lidar_link, tf, camera, points, static=False)
    robot = urdf(T_LIDAR_CAMERA, tmp_path / "robot.urdf")
    assert "import bag` would stop" in command("inspect", path).output
    shown = command("inspect", path, "--urdf", robot).output
    assert "would stop" not in shown and "photos; frame camera" in shown
    result = command("import", "bag", path, "--urdf", robot, "--out", tmp_path / "tile", "--min-range", 0)
    assert result.exit_code == 0 and len(read_tile(tmp_path / "tile").views) == SWEEPS


def graph(path: Path, *writers: Writer, **options: object) -> dict[str, Task]:
    """Tasks of an import by step."""
    if not path.exists():
        write(path, "mcap", *writers)
    return {task.step.name: task for task in build_graph(BagSource(file=path, **options), path.parent)}


def test_steps_depend_on_what_the_bag_contains(tmp_path: Path) -> None:
    checked = graph(tmp_path / "tf", tf, points)
    assert list(checked) == ["read_bag", "strip_adjustment", "import_sweeps"]
    assert "trajectory_check" in checked["import_sweeps"].inputs
    assert list(graph(tmp_path / "given", tf, points, pose_source="given")) == ["read_bag", "import_sweeps"]
    tasks = graph(tmp_path / "none", points)
    assert list(tasks) == ["read_bag", "lidar", "fuse", "import_sweeps"] and "gps" not in tasks["fuse"].inputs
    tasks = graph(tmp_path / "gps", points, poor_gps)
    assert "gps" in tasks["fuse"].inputs and "poses" not in tasks["fuse"].inputs
    assert tasks["import_sweeps"].params.crs == "EPSG:32632"  # type: ignore[attr-defined]
    tasks = graph(tmp_path / "odometry", points, odometry, lidar_odometry=True)
    assert {"matched", "poses"} <= set(tasks["fuse"].inputs)
    assert tasks["lidar"].params.deskew == "times"  # type: ignore[attr-defined]
    plain = graph(tmp_path / "plain", tf, lambda b, k, t: b.cloud("/points", t, "lidar", records(XYZ)))
    assert plain["import_sweeps"].params.deskew == "none"  # type: ignore[attr-defined]


def test_import_reports_the_lidars_that_it_leaves_out(tmp_path: Path) -> None:
    def second(bag: BagFile, k: int, time: float) -> None:
        bag.cloud("/second", time, "unknown", records(XYZ[:20]))

    path = write(tmp_path / "bag", "mcap", tf, points, second)
    result = command("import", "bag", path, "--out", tmp_path / "tile", "--min-range", 0)
    assert result.exit_code == 0
    for shown in (result.output, command("inspect", path).output):
        assert "/second is left out: no static transform to 'lidar' from 'unknown'" in shown


def test_drive_with_a_bag_becomes_a_survey_and_is_cached(tmp_path: Path) -> None:
    write(tmp_path / "bag", "sqlite3", sweeps=25)
    place = drive(tmp_path, '[bag]\nfile = "bag"\nmin_range = 0.5\nlidar = ["/points"]\n[tiles]\nlength = 20.0\n')
    assert Path(survey_of(place, tmp_path / "out")).is_file()

    def changed() -> set[str]:
        return {item.task.id.name for item in plan_drive(place, tmp_path / "out" / "prepared")[0] if item.reason}

    assert changed() == set()
    place.write_text(place.read_text(encoding="utf-8").replace("0.5", "0.7"), encoding="utf-8")
    assert changed() == {"strip_adjustment", "import_sweeps", "cut"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[bag]\nfile = "bag"\n[sweeps]\nfolder = "a"\n', "must have either"),
        ('[bag]\nfile = "bag"\n[slam]\nvideo = "a.mp4"\n', "must have either"),
        ('[bag]\nlidar = ["/a"]\n', r"field `bag\.file`"),
        ('[bag]\nfile = "bag"\nstamps = "gps"\n', r"field `bag\.stamps`"),
        ('[bag]\nfile = "nothing.mcap"\n', r"nothing\.mcap: file not found"),
    ],
)
def test_wrong_drives_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        survey_of(drive(tmp_path, text), tmp_path / "out")


def test_an_empty_bag_is_named(tmp_path: Path) -> None:
    with bag_file(tmp_path / "empty", "mcap"):
        pass
    assert "contains no messages" in str(command("inspect", tmp_path / "empty").exception)
