"""`scan2sim run` and `import` with damaged, incomplete or unusual input: worlds with warnings, or errors that help."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from PIL import Image

from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.tile import read_tile
from tests.flows.command import assert_fails, in_process, options, stdout_of
from tests.flows.inline_steps import inline_steps
from tests.flows.tiny import COARSE, tiny

FAST = options(COARSE | {"export": {}})


@pytest.fixture(scope="module")
def street(small_street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small street with a tenth of its points and half of its photos."""
    return tiny(small_street, tmp_path_factory.mktemp("street") / "tile", photos=4)


@pytest.fixture
def damaged(street: Path, tmp_path: Path) -> Path:
    """A copy of the street to damage."""
    shutil.copytree(street, tmp_path / "tile")
    return tmp_path / "tile"


@pytest.fixture(scope="module")
def unreadable_photos(street: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A finished run of the street with a missing and two damaged photos, and the names of these."""
    folder = tmp_path_factory.mktemp("unreadable_photos")
    tile = shutil.copytree(street, folder / "tile")
    photos = sorted((tile / "photos").rglob("*.jpg"))
    photos[0].unlink()
    photos[1].write_bytes(b"no photo")
    data = photos[2].read_bytes()
    photos[2].write_bytes(data[: len(data) // 3])
    with inline_steps():
        stdout_of(in_process("run", tile, "--out", folder / "out", *FAST))
    return folder / "out", [photo.name for photo in photos[:3]]


def edit(tile: Path, old: str, new: str, count: int = 1) -> None:
    text = (tile / "tile.toml").read_text(encoding="utf-8")
    assert old in text
    (tile / "tile.toml").write_text(text.replace(old, new, count), encoding="utf-8")


def test_cloud_without_photos_colours_and_classes(street: Path, tmp_path: Path) -> None:
    frame = Frame("EPSG:32633", (500000.0, 5400000.0, 200.0))
    cloud = las.read(street / "cloud.laz", read_tile(street).frame)
    las.write(tmp_path / "plain.laz", PointCloud(frame, cloud.xyz))
    stdout_of(in_process("import", "las", tmp_path / "plain.laz", "--out", tmp_path / "tile"))
    with inline_steps():
        stdout_of(in_process("run", tmp_path / "tile", "--out", tmp_path / "out", *FAST))
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert report["texture"]["coverage"] == 0 and report["steps"]["segment"]["metrics"]["source"] == "shape"


def test_truncated_cloud_is_an_input_error(damaged: Path, tmp_path: Path) -> None:
    data = (damaged / "cloud.laz").read_bytes()
    (damaged / "cloud.laz").write_bytes(data[: len(data) // 2])
    assert_fails(in_process("run", damaged, "--out", tmp_path / "out"), 3, "cloud.laz", "Copy or export the file again")


def test_missing_crs_is_an_input_error(damaged: Path, tmp_path: Path) -> None:
    cloud = las.read(damaged / "cloud.laz", read_tile(damaged).frame)
    las.write(damaged / "cloud.laz", PointCloud(Frame(), cloud.xyz))
    text = (damaged / "tile.toml").read_text(encoding="utf-8")
    (damaged / "tile.toml").write_text(
        "\n".join(line for line in text.splitlines() if not line.startswith("crs")), encoding="utf-8"
    )
    assert_fails(in_process("run", damaged, "--out", tmp_path / "out"), 3, "cloud.laz", "no CRS", 'crs = "local"')


def test_clouds_with_different_crs_are_an_input_error(damaged: Path, tmp_path: Path) -> None:
    cloud = las.read(damaged / "cloud.laz", read_tile(damaged).frame)
    las.write(damaged / "other.laz", PointCloud(Frame("EPSG:2154", (600000.0, 6000000.0, 0.0)), cloud.xyz[:5000]))
    edit(damaged, '"cloud.laz"', '"cloud.laz", "other.laz"')
    edit(damaged, f'crs = "{cloud.frame.crs}"', "")
    assert_fails(in_process("run", damaged, "--out", tmp_path / "out"), 3, "other.laz", "EPSG:2154", "one CRS")


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
        in_process("run", damaged, "--out", tmp_path / "out", *FAST),
        4,
        "photos sees a point of the cloud",
        "CRS, units and axes",
    )


def test_missing_and_unreadable_photos_are_skipped_with_a_warning(unreadable_photos: tuple[Path, list[str]]) -> None:
    out, photos = unreadable_photos
    findings = json.loads((out / "report.json").read_text(encoding="utf-8"))["findings"]
    for photo in photos:
        assert any(photo in finding["text"] for finding in findings), findings


@pytest.mark.slow
def test_masked_pixels_are_not_used(damaged: Path, tmp_path: Path) -> None:
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
    with inline_steps():
        stdout_of(in_process("run", damaged, "--out", tmp_path / "out", *FAST))
    assert json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))["texture"]["coverage"] == 0


def test_folder_that_is_not_a_tile_is_not_overwritten(street: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    result = in_process("import", "las", street / "cloud.laz", "--out", tmp_path, "--overwrite")
    assert_fails(result, 2, "is not a tile")
    assert (tmp_path / "notes.txt").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize("given", [["--jobs", "-1"], ["--set", "ingest.unit=2.0"], ["--set", "split.roof.x=1"]])
def test_invalid_options_are_setting_errors(street: Path, tmp_path: Path, given: list[str]) -> None:
    assert in_process("run", street, "--out", tmp_path / "out", *given).returncode == 2


def test_missing_photo_folder_is_an_input_error(damaged: Path, tmp_path: Path) -> None:
    shutil.rmtree(damaged / "photos")
    assert_fails(in_process("run", damaged, "--out", tmp_path / "out", *FAST), 3, "no photo of the tile can be read")


def test_invalid_poses_are_input_errors(damaged: Path, tmp_path: Path) -> None:
    text = (damaged / "tile.toml").read_text(encoding="utf-8")
    head, tail = text.split("rotation", 1)
    (damaged / "tile.toml").write_text(
        head + "rotation = [[1,0,0],[0,2,0],[0,0,1]]\n#" + _one_line(tail), encoding="utf-8"
    )
    assert_fails(in_process("run", damaged, "--out", tmp_path / "out"), 3, "tile.toml", "is not a rotation matrix")
    head, tail = text.split("position", 1)
    (damaged / "tile.toml").write_text(head + "position = [nan, 0.0, 0.0]\n#" + _one_line(tail), encoding="utf-8")
    assert_fails(in_process("run", damaged, "--out", tmp_path / "out"), 3, "tile.toml", "NaN")


def test_bad_input_keeps_earlier_results(
    street: Path, unreadable_photos: tuple[Path, list[str]], tmp_path: Path
) -> None:
    shutil.copytree(unreadable_photos[0], tmp_path / "out", symlinks=True)
    shutil.copytree(street, tmp_path / "tile")
    data = (tmp_path / "tile" / "cloud.laz").read_bytes()
    (tmp_path / "tile" / "cloud.laz").write_bytes(data[:-1000])
    before = {p.relative_to(tmp_path): p.stat().st_size for p in (tmp_path / "out" / "world").rglob("*") if p.is_file()}
    assert in_process("run", tmp_path / "tile", "--out", tmp_path / "out", *FAST).returncode == 3
    assert before and before == {
        p.relative_to(tmp_path): p.stat().st_size for p in (tmp_path / "out" / "world").rglob("*") if p.is_file()
    }
    assert list((tmp_path / "out" / "steps" / "poisson.terrain").glob("*/mesh.npz"))


def _one_line(rest: str) -> str:
    """The rest of a TOML file with the value at its start joined to one line, to be commented out."""
    depth, end = 0, rest.index("[")
    while depth > 0 or rest[end] == "[":
        depth += {"[": 1, "]": -1}.get(rest[end], 0)
        end += 1
    return rest[:end].replace("\n", " ") + rest[end:]
