"""Tables of photos as other programs and systems write them; photos of another size, or with an EXIF orientation."""

from __future__ import annotations

import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest
from PIL import Image

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Camera, Tile
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.importers.photo_fit import scaled_to
from scan2sim.pipeline.io.photogrammetry import Photos
from scan2sim.pipeline.io.tile import read_tile

HEAD = "file,x,y,z,qw,qx,qy,qz,model,width,height,fx,cx,cy,k1"
NAMES = ("Straße_1.jpg", "Straße_2.jpg")


def recording(folder: Path, *, size: tuple[int, int] = (64, 48), orientation: int = 1) -> Path:
    """A cloud and two photos in `photos/`; returns the folder."""
    (folder / "photos").mkdir(parents=True)
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales = [0.001] * 3
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = np.random.default_rng(1).random((3, 100)) * 10
    cloud.write(folder / "cloud.las")
    for name in NAMES:
        image = Image.new("RGB", size)
        exif = image.getexif()
        exif[274] = orientation
        image.save(folder / "photos" / name, exif=exif)
    return folder


def rows(rename: Callable[[str], str] = lambda name: f"photos/{name}") -> list[list[str]]:
    return [[rename(name), "1.5", "2.25", "-3", "1", "0", "0", "0", "opencv", "64", "48", "50.5", "31", "23", "-0.125"]
            for name in NAMES]  # fmt: skip


def imported(folder: Path, text: str, encoding: str = "utf-8") -> tuple[Tile, list[str]]:
    """The tile made of a photos table, and the warnings."""
    (folder / "photos.csv").write_bytes(text.encode(encoding))
    notes: list[str] = []
    import_las([folder / "cloud.las"], folder / "tile", photos=folder / "photos.csv", crs="local", warn=notes.append)
    return read_tile(folder / "tile"), notes


def table(
    separator: str = ",", *, comma: bool = False, head: str = HEAD, end: str = "\n", **how: Callable[[str], str]
) -> str:
    cells = [head.split(","), *rows(**how)]
    if comma:
        cells = [cells[0], *([row[0], *(cell.replace(".", ",") for cell in row[1:])] for row in cells[1:])]
    return end.join(separator.join(row) for row in cells) + end


TABLES: dict[str, tuple[str, str]] = {
    "plain": (table(), "utf-8"),
    "byte order mark": (table(end="\r\n"), "utf-8-sig"),
    "semicolons": (table(";"), "utf-8"),
    "German Excel": (table(";", comma=True, end="\r\n"), "cp1252"),
    "tabs, decimal commas": (table("\t", comma=True), "utf-8"),
    "Unicode text": (table("\t", end="\r\n"), "utf-16"),
    "capitals": (table(head=HEAD.upper()), "utf-8"),
    "title case": (table(head=HEAD.title()), "utf-8"),
    "German headings": (table(head=HEAD.replace("file,x,y,z", "Dateiname,Rechtswert,Hochwert,Höhe")), "cp1252"),
    "backslashes": (table(rename=lambda name: f"photos\\{name}"), "utf-8"),
    "drive": (table(rename=lambda name: f"D:\\Projekt Süd\\photos\\{name}"), "cp1252"),
    "other case": (table(rename=lambda name: f"Photos/{name.upper()}"), "utf-8"),
    "NFD": (table(rename=lambda name: unicodedata.normalize("NFD", f"photos/{name}")), "utf-8"),
    "names only": (table(rename=lambda name: name), "utf-8"),
    "empty lines": (table().replace("\n", "\n\n"), "utf-8"),
    "trailing commas": (table(end=",,\n"), "utf-8"),
}


@pytest.mark.parametrize("name", TABLES)
def test_every_habit_gives_the_same_tile(tmp_path: Path, name: str) -> None:
    tile, notes = imported(recording(tmp_path), *TABLES[name])
    assert [view.photo.name for view in tile.views] == list(NAMES) and not notes
    assert {view.photo.parent for view in tile.views} == {tmp_path / "tile" / "photos"}, "not photos/photos"
    for view in tile.views:
        centre = tile.frame.to_crs(view.T_world_cam[None, :3, 3])[0]
        assert np.allclose(centre, (1.5, 2.25, -3)) and view.camera.fx == 50.5 and view.camera.distortion[0] == -0.125


def test_extra_columns_are_ignored_with_a_note_and_misspelled_ones_named(tmp_path: Path) -> None:
    text = table().replace("k1\n", "k1,accuracy_m\n").replace("-0.125\n", "-0.125,0.02\n")
    _, notes = imported(recording(tmp_path / "a"), text)
    assert len(notes) == 1 and "accuracy_m" in notes[0]
    with pytest.raises(InputError, match=r"unknown column `widht`\. Name it `width`"):
        imported(recording(tmp_path / "b"), table(head=HEAD.replace("width", "widht")))


def test_decimal_commas_between_commas_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"row 2: 19 cells, but 15 columns"):
        imported(recording(tmp_path), table(comma=True))


@pytest.mark.parametrize(("content", "cause"), [(b"", "is empty"), (b"\x89PNG\0\0", "not a text file")])
def test_what_is_no_table_is_named(tmp_path: Path, content: bytes, cause: str) -> None:
    folder = recording(tmp_path)
    (folder / "photos.csv").write_bytes(content)
    with pytest.raises(InputError, match=cause):
        import_las([folder / "cloud.las"], folder / "tile", photos=folder / "photos.csv", crs="local")


def test_photos_of_the_same_name_are_distinguished_by_their_folders(tmp_path: Path) -> None:
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
        Image.new("RGB", (8, 8)).save(tmp_path / folder / "1.jpg")
    found = Photos(tmp_path).find("E:\\job\\LEFT\\1.JPG")
    assert found == tmp_path / "left" / "1.jpg"
    shutil.copytree(tmp_path / "left", tmp_path / "tile" / "photos" / "left")  # an earlier import beside them
    assert Photos(tmp_path).find("E:\\job\\LEFT\\1.JPG") == found
    with pytest.raises(InputError, match="2 photos named"):
        Photos(tmp_path).find("E:\\job\\middle\\1.jpg")


@pytest.mark.parametrize("size", [(32, 24), (128, 96), (33, 25), (16, 12)])
def test_cameras_are_scaled_to_their_photos(tmp_path: Path, size: tuple[int, int]) -> None:
    tile, notes = imported(recording(tmp_path, size=size), table())
    camera, scale = tile.views[0].camera, size[0] / 64
    assert (camera.width, camera.height) == size
    assert camera.fx == pytest.approx(50.5 * scale) and camera.cx == pytest.approx(31.5 * scale - 0.5)
    assert len(notes) == 1 and notes[0].startswith(f"2 photos have {size[0]} x {size[1]} pixels")


def test_a_scaled_camera_projects_to_the_same_places() -> None:
    camera = Camera("opencv", 400, 300, 320.0, 330.0, 190.0, 160.0, (-0.1, 0.02, 0.001, -0.002))
    small = scaled_to(camera, (200, 150))
    assert small is not None and small.distortion == camera.distortion
    x, y = 0.3, -0.2  # on the normalized plane: the centre of a pixel is at +.5 of its corner
    for focal, centre, new_focal, new_centre, at in (
        (camera.fx, camera.cx, small.fx, small.cx, x), (camera.fy, camera.cy, small.fy, small.cy, y),
    ):  # fmt: skip
        assert new_focal * at + new_centre + 0.5 == pytest.approx((focal * at + centre + 0.5) / 2)
    assert scaled_to(camera, (300, 400)) is None and scaled_to(camera, (200, 140)) is None


def test_an_exif_orientation_is_named(tmp_path: Path) -> None:
    _, notes = imported(recording(tmp_path, orientation=3), table())
    assert len(notes) == 1 and notes[0].startswith("2 photos (Straße_1.jpg, ...) have an EXIF orientation")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("#cameras 1\n#name,x,y,alt,heading,pitch,roll,f,px,py\na.jpg,1,2,3,0,0,0,24,0,0\n", "RealityCapture.*colmap"),
        ("# Cameras (1)\n# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11\na.jpg\t1\t2\t3\t0\t0\t0\t1\n", "import metashape"),
        ("#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw\na.jpg,1,2,3,0\n", "reference.*import metashape"),
        ("imageName X Y Z Omega Phi Kappa\na.jpg 1 2 3 0 0 0\n", "external camera parameters.*import pix4d"),
    ],
)
def test_tables_of_poses_without_a_lens_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        imported(recording(tmp_path), text)


def test_angles_in_gon_are_refused(tmp_path: Path) -> None:
    head = "file,x,y,z,omega,phi,kappa,width,height,fx"
    row = "photos/{},1,2,3,0.5,399.5,{},64,48,50"
    with pytest.raises(InputError, match=r"row 2: an angle of 399\.5 is more than a full circle.*times 0\.9"):
        imported(recording(tmp_path), "\n".join([head, *(row.format(name, 210) for name in NAMES)]))
