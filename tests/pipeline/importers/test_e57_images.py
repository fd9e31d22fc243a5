"""Images in E57 files, drawn by the equations of ASTM E2807: known points project to their pixels in the tile."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.flows.commands.robot_map import tile_of_map
from scan2sim.pipeline.camera.models import inside, project
from scan2sim.pipeline.core.types import F64, U8, Tile, View
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.importers.robot_map import MapParams
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.images.e57 import CYLINDRICAL, PINHOLE, SPHERICAL
from scan2sim.pipeline.io.images.image import read_mask, read_photo
from scan2sim.pipeline.io.tile import read_tile
from tests.conftest import ROOT
from tests.fakes import e57_files
from tests.fakes.e57_files import Image2D
from tests.pipeline.importers.test_robot_map import room
from tests.present import present

TILE = ROOT / "data_samples" / "tile"
DEG = math.radians(1)
AT = np.array([391_206.0, 5_820_376.5, 36.7])
TURN = Rotation.from_euler("ZYX", [0.7, 0.06, -0.04])
"""Position and rotation of the images, on the sample street's path, tilted a bit."""
FORWARD = Rotation.from_matrix([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])
"""Axes of a pinhole image (x right, y up, z back) that looks along x, z up."""


def street(count: int = 4000) -> F64:
    """(N, 3) points of the sample street, CRS coordinates."""
    tile = read_tile(TILE)
    cloud = clouds.read(tile.clouds[0], tile.frame)
    return tile.frame.to_crs(cloud.xyz[np.random.default_rng(0).choice(len(cloud), count, replace=False)])


def pixels(image: Image2D, xyz: F64) -> tuple[F64, np.ndarray]:
    """Image coordinates (N, 2), (0, 0) at the corner, of points in the image's axes, and whether they are visible.

    The equations 20 to 25 of the standard, literally.
    """
    n, (width, height) = image.numbers, image.size
    x, y, z = xyz.T
    if image.kind == PINHOLE:
        u = n["principalPointX"] - x / z * n["focalLength"] / n["pixelWidth"]
        v = n["principalPointY"] + y / z * n["focalLength"] / n["pixelHeight"]
        return np.column_stack([u, v]), z < 0
    azimuth = np.arctan2(y, x)
    u = width / 2 - azimuth / n["pixelWidth"]
    if image.kind == SPHERICAL:
        v = height / 2 - np.arctan2(z, np.hypot(x, y)) / n["pixelHeight"]
    else:
        v = n["principalPointY"] - z * (n["radius"] / n["pixelHeight"]) / np.hypot(x, y)
    return np.column_stack([u, v]), np.ones(len(xyz), bool)


def drawn(image: Image2D, points: F64, encode: str = ".png") -> tuple[Image2D, F64]:
    """The image with a spot at every point (CRS) that it shows, at least 14 pixels apart; and these points."""
    rotation = Rotation.from_quat(present(image.rotation), scalar_first=True)
    at, seen = pixels(image, rotation.inv().apply(points - np.array(image.translation)))
    width, height = image.size
    seen &= ((at > 8) & (at < np.array([width, height]) - 8)).all(axis=1)
    canvas, kept = np.full((height, width), 30.0), list[int]()
    for i in np.flatnonzero(seen).tolist():
        if not kept or np.abs(at[kept] - at[i]).max(axis=1).min() > 14:
            kept.append(i)
            column, row = at[i].astype(int)
            v, u = np.mgrid[row - 7 : row + 8, column - 7 : column + 8]
            spot = np.exp(-((u + 0.5 - at[i, 0]) ** 2 + (v + 0.5 - at[i, 1]) ** 2) / (2 * 1.5**2))
            canvas[v, u] += 200 * spot
    assert len(kept) > 10
    levels = np.rint(canvas).clip(0, 255).astype(np.uint8)
    data = cv2.imencode(encode, np.repeat(levels[..., None], 3, axis=2))[1].tobytes()
    return replace(image, blobs={"pngImage" if encode == ".png" else "jpegImage": data}), points[kept]


def errors(tile: Tile, view: View, points: F64) -> F64:
    """Distance (N,) in pixels of projected points (CRS) from spots in the photo; NaN for points outside the view."""
    photo = read_photo(view)[..., 0].astype(np.float64) - 30
    local = (tile.frame.to_local(points) - view.T_world_cam[:3, 3]) @ view.T_world_cam[:3, :3]
    uv, valid = project(view.camera, local)
    out = np.full(len(points), np.nan)
    for i in np.flatnonzero(valid & inside(view.camera, uv)):
        u, v = np.rint(uv[i]).astype(int)
        part = photo[max(v - 6, 0) : v + 7, max(u - 6, 0) : u + 7]
        if part.shape != (13, 13):
            continue
        part = np.where(part > 6, part, 0)
        rows, columns = np.mgrid[v - 6 : v + 7, u - 6 : u + 7]
        centre = np.array([(part * columns).sum(), (part * rows).sum()]) / max(part.sum(), 1e-9)
        out[i] = np.hypot(*(centre - uv[i]))
    return out


def sized(
    kind: str, size: tuple[int, int], numbers: Mapping[str, float], turn: Rotation = TURN, name: str = ""
) -> Image2D:
    return Image2D(kind, numbers, {}, size, turn.as_quat(scalar_first=True).tolist(), AT.tolist(), name)


def ball(size: tuple[int, int], degrees: tuple[float, float]) -> Image2D:
    """A spherical image of `size` pixels that covers `degrees`."""
    numbers = {"pixelWidth": degrees[0] * DEG / size[0], "pixelHeight": degrees[1] * DEG / size[1]}
    return sized(SPHERICAL, size, numbers)


def roll(size: tuple[int, int], degrees: float, top: float, radius: float = 0.4) -> Image2D:
    """A cylindrical image that covers `degrees` around, square pixels, with the horizon `top` of the height down."""
    width = degrees * DEG / size[0]
    numbers = {"pixelWidth": width, "pixelHeight": width * radius, "radius": radius, "principalPointY": top * size[1]}
    return sized(CYLINDRICAL, size, numbers)


def imported(path: Path, out: Path) -> tuple[Tile, list[str]]:
    warned: list[str] = []
    return read_tile(import_las([path], out, crs="EPSG:32633", warn=warned.append)), warned


LENS = {
    "focalLength": 0.02,
    "pixelWidth": 5e-5,
    "pixelHeight": 4e-5,
    "principalPointX": 395.0,
    "principalPointY": 310.5,
}
IMAGES = {
    "pinhole": (sized(PINHOLE, (800, 600), LENS, TURN * FORWARD), "pinhole"),
    "sphere": (ball((1600, 800), (360, 180)), "equirectangular"),
    "wide part of a sphere": (ball((1200, 500), (270, 112.5)), "equirectangular"),
    "wide part of a sphere, other pixels": (ball((1201, 500), (271.3, 110)), "equirectangular"),
    "narrow part of a sphere": (ball((900, 500), (80, 45)), "pinhole"),
    "cylinder": (roll((1600, 700), 360, 0.6), "equirectangular"),
    "part of a cylinder": (roll((900, 500), 75, 0.3), "pinhole"),
}


@pytest.mark.parametrize("kind", IMAGES)
def test_points_project_as_defined_by_the_standard(tmp_path: Path, kind: str) -> None:
    """Known points of the street in all representations: to 0.05 pixels, or 0.1 pixels if the image is resampled."""
    image, points = drawn(IMAGES[kind][0], street())
    tile, warned = imported(e57_files.write(tmp_path / "scan.e57", street(), [image]), tmp_path / "tile")
    (view,) = tile.views
    assert not warned and view.camera.model == IMAGES[kind][1]
    off = errors(tile, view, points)
    resampled = kind not in ("pinhole", "sphere")
    assert np.isfinite(off).all() and off.max() < (0.1 if resampled else 0.05), off
    mask = read_mask(view)
    assert (view.photo.read_bytes() == image.blobs["pngImage"]) is not resampled
    if mask is None:
        assert view.camera.model == "pinhole" or not resampled
    else:
        local = (tile.frame.to_local(points) - view.T_world_cam[:3, 3]) @ view.T_world_cam[:3, :3]
        u, v = np.rint(project(view.camera, local)[0]).astype(int).T
        assert (mask[v, u] == 255).all() and 0.1 < (mask == 0).mean() < 0.9


def test_pixels_of_a_partial_sphere_are_copied_unchanged(tmp_path: Path) -> None:
    image, _ = drawn(ball((1200, 500), (270, 112.5)), street())
    tile, _ = imported(e57_files.write(tmp_path / "scan.e57", street(), [image]), tmp_path / "tile")
    photo, mask = read_photo(tile.views[0]), present(read_mask(tile.views[0]))
    assert photo.shape == (800, 1600, 3) and (mask > 0).sum() == 1200 * 500
    original = cv2.imdecode(np.frombuffer(image.blobs["pngImage"], np.uint8), cv2.IMREAD_COLOR)
    assert (photo[150:650, 200:1400] == original).all() and (mask[150:650, 200:1400] == 255).all()


def test_six_cube_faces_cover_all_points(tmp_path: Path) -> None:
    turns = [FORWARD * Rotation.from_euler("Y", 90 * i, degrees=True) for i in range(4)]
    turns += [FORWARD * Rotation.from_euler("X", angle, degrees=True) for angle in (90, -90)]
    cube = {"focalLength": 0.5, "pixelWidth": 1 / 512, "pixelHeight": 1 / 512}
    cube |= {"principalPointX": 256, "principalPointY": 256}
    points, faces, shown = street(), [], np.zeros(4000, bool)
    for i, turn in enumerate(turns):
        face = sized(PINHOLE, (512, 512), cube, TURN * turn, f"Skybox {i}")
        at, front = pixels(face, Rotation.from_quat(present(face.rotation), scalar_first=True).inv().apply(points - AT))
        seen = front & ((at >= 0) & (at <= 512)).all(axis=1)
        shown |= seen
        faces.append(drawn(face, points) if seen.sum() > 50 else (replace(face, blobs=flat(512, 512)), points[:0]))
    assert shown.all()
    path = e57_files.write(tmp_path / "scan.e57", points, [face for face, _ in faces])
    tile, warned = imported(path, tmp_path / "tile")
    assert not warned and [view.photo.stem for view in tile.views] == [f"Skybox_{i}" for i in range(6)]
    assert len({view.camera for view in tile.views}) == 1
    for view, (_, marked) in zip(tile.views, faces, strict=True):
        off = errors(tile, view, marked)
        assert np.isfinite(off).all() and (off < 0.05).all()


def flat(width: int, height: int, encode: str = ".jpg") -> dict[str, bytes]:
    key = "pngImage" if encode == ".png" else "jpegImage"
    return {key: cv2.imencode(encode, np.full((height, width, 3), 90, np.uint8))[1].tobytes()}


def png(levels: U8) -> bytes:
    return cv2.imencode(".png", levels)[1].tobytes()


def test_sample_photos_round_trip_through_e57(tmp_path: Path) -> None:
    """Its panoramas and pinhole photos: same bytes, cameras, poses and times."""
    tile = read_tile(TILE)
    views = [view for view in tile.views if view.camera.model in ("pinhole", "equirectangular")]
    images = []
    for view in views:
        camera, R = view.camera, view.T_world_cam[:3, :3]
        around = camera.model == "equirectangular"
        # columns: axes of the image by the standard, in camera axes
        R = R @ (np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]) if around else np.diag([1, -1, -1]))
        numbers = {"pixelWidth": 2 * math.pi / camera.width, "pixelHeight": math.pi / camera.height}
        if not around:
            numbers = {"pixelWidth": 1e-5, "pixelHeight": 1e-5, "focalLength": camera.fx * 1e-5}
            numbers |= {"principalPointX": camera.cx + 0.5, "principalPointY": camera.cy + 0.5}
        images.append(
            Image2D(
                SPHERICAL if around else PINHOLE,
                numbers,
                {"jpegImage": view.photo.read_bytes()},
                (camera.width, camera.height),
                Rotation.from_matrix(R).as_quat(scalar_first=True).tolist(),
                tile.frame.to_crs(view.centre).tolist(),
                view.photo.name,
                time=view.time,
            )
        )
    again, warned = imported(e57_files.write(tmp_path / "s.e57", street(), images), tmp_path / "tile")
    assert not warned and len(again.views) == len(views) > 5
    for old, new in zip(views, again.views, strict=True):
        assert new.photo.read_bytes() == old.photo.read_bytes() and new.photo.stem == old.photo.stem
        assert new.time == old.time and new.camera.model == old.camera.model
        assert np.allclose(new.T_world_cam[:3, :3], old.T_world_cam[:3, :3], atol=1e-9)
        assert np.allclose(again.frame.to_crs(new.centre), tile.frame.to_crs(old.centre), atol=1e-6)
        for key in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(new.camera, key) == pytest.approx(getattr(old.camera, key))


def test_masks_are_imported(tmp_path: Path) -> None:
    levels = np.zeros((400, 800), np.uint8)
    levels[:300] = 1  # "non-zero-valued pixels at locations where the image is valid"
    whole = ball((800, 400), (360, 180))
    part = ball((800, 400), (180, 90))
    images = [
        replace(image, blobs=flat(800, 400) | {"imageMask": png(mask)}, name=name)
        for image, mask, name in ((whole, levels, "whole"), (part, levels, "part"), (whole, levels[:99], "small"))
    ]
    tile, warned = imported(e57_files.write(tmp_path / "scan.e57", street(), images), tmp_path / "tile")
    first, second, third = (read_mask(view) for view in tile.views)
    assert (present(first)[:300] > 0).all() and not present(first)[300:].any()
    assert present(second).shape == (800, 1600)
    assert (present(second)[200:500, 400:1200] == 255).all() and (present(second) > 0).sum() == 300 * 800
    assert third is None and len(warned) == 1
    assert "image small is used without its mask: it is 800 x 99 pixels" in warned[0]


def test_panorama_without_a_pose_gets_that_of_its_scan(tmp_path: Path) -> None:
    points = street()
    image, marked = drawn(ball((1600, 800), (360, 180)), points)
    image = replace(image, rotation=None, associated=True, name="pano")
    pose = (TURN.as_quat(scalar_first=True).tolist(), AT.tolist())
    tile, warned = imported(e57_files.write(tmp_path / "scan.e57", points, [image], pose), tmp_path / "tile")
    assert np.nanmax(errors(tile, tile.views[0], marked)) < 0.05
    assert "image pano has no pose: that of its scan is used" in warned[0]
    read = tile.frame.to_crs(clouds.read(tile.clouds[0], tile.frame).xyz)
    assert np.abs(np.sort(read[:, 0]) - np.sort(points[:, 0])).max() < 0.02  # the points are unchanged


GOOD = replace(sized(PINHOLE, (80, 60), LENS, name="good"), blobs=flat(80, 60))
WHOLE = replace(ball((80, 40), (360, 180)), blobs=flat(80, 40))


@pytest.mark.parametrize(
    ("image", "cause"),
    [
        (replace(GOOD, blobs={"jpegImage": flat(80, 60)["jpegImage"][:300]}), "can't be read"),
        (replace(GOOD, blobs={"jpegImage": b"no picture"}), "can't be read"),
        (replace(GOOD, blobs={}), "has no jpegImage or pngImage"),
        (replace(GOOD, blobs=flat(60, 80)), "is 60 x 80 pixels, but the file says 80 x 60"),
        (replace(GOOD, rotation=None), "has no pose"),
        (replace(GOOD, rotation=None, associated=True), "has no pose"),
        (replace(WHOLE, rotation=None), "has no pose"),
        (replace(GOOD, rotation=(0, 0, 0, 0)), "can't be read"),
        (replace(GOOD, numbers=LENS | {"focalLength": 0}), r"has no valid focalLength \(0\)"),
        (replace(GOOD, numbers={"focalLength": 0.02}), r"has no valid pixelWidth \(nan\)"),
        (replace(GOOD, numbers=LENS | {"focalLength": 1e9}), "has a focal length of"),
        (replace(GOOD, numbers=LENS | {"principalPointX": -1e9}), r"has no valid principalPointX \(-1e\+09\)"),
        (replace(WHOLE, numbers={"pixelWidth": 1e-300, "pixelHeight": 0.01}), "has pixels of 1e-300 rad"),
        (replace(roll((80, 60), 90, 1e4), blobs=flat(80, 60)), "shows nothing"),
        (replace(WHOLE, size=(80, 60), blobs=flat(80, 60)), "covers more than the sphere"),
        (replace(roll((80, 60), 500, 0.5), blobs=flat(80, 60)), "covers more than a full circle"),
    ],
)  # fmt: skip
def test_invalid_image_is_reported_and_skipped(tmp_path: Path, image: Image2D, cause: str) -> None:
    path = e57_files.write(tmp_path / "scan.e57", street(50), [replace(image, name="bad.jpg"), GOOD])
    tile, (warning,) = imported(path, tmp_path / "tile")
    assert re.search(rf"scan\.e57: image bad(\.jpg)? is left out: it {cause}", warning), warning
    assert [view.photo.name for view in tile.views] == ["good.jpg"]
    assert [file.name for file in (tmp_path / "tile" / "photos").rglob("*.*")] == ["good.jpg"]


def test_images_for_reference_only_are_counted(tmp_path: Path) -> None:
    reference = Image2D("visualReferenceRepresentation", {}, flat(80, 60), (80, 60))
    path = e57_files.write(tmp_path / "scan.e57", street(50), [reference, GOOD, reference])
    tile, warned = imported(path, tmp_path / "tile")
    assert len(tile.views) == 1 and len(warned) == 1
    assert "2 of 3 images have no projection" in warned[0]


@pytest.mark.parametrize("pixel", [5e-6, 360 / 800])
def test_full_sphere_with_an_impossible_pixel_size_is_imported(tmp_path: Path, pixel: float) -> None:
    """As ReCap and others accept: 5e-6 in an example for manufacturers, or degrees."""
    image, points = drawn(ball((800, 400), (360, 180)), street())
    image = replace(image, numbers={"pixelWidth": pixel, "pixelHeight": pixel}, name="pano")
    tile, warned = imported(e57_files.write(tmp_path / "scan.e57", street(), [image]), tmp_path / "tile")
    assert np.nanmax(errors(tile, tile.views[0], points)) < 0.05
    assert "image pano has an impossible pixel size" in warned[0] and len(warned) == 1


def test_duplicate_image_names_get_suffixes_and_unsafe_names_are_sanitized(tmp_path: Path) -> None:
    names = ["a.jpg", "a", "../../a", "C:\\photos\\b.JPG", "", "ü x"]
    images = [replace(GOOD, name=name) for name in names]
    tile, _ = imported(e57_files.write(tmp_path / "scan.e57", street(50), images), tmp_path / "tile")
    photos = [view.photo.relative_to(tmp_path / "tile").as_posix() for view in tile.views]
    assert photos == [f"photos/scan/{name}.jpg" for name in ("a", "a_2", "a_3", "b", "4", "ü_x")]


@pytest.mark.parametrize("options", [[], ["--no-images"]])
def test_command_imports_images_unless_disabled(tmp_path: Path, options: Sequence[str]) -> None:
    path = e57_files.write(tmp_path / "scan.e57", street(50), [GOOD])
    done = CliRunner().invoke(
        app, ["import", "clouds", str(path), "-o", str(tmp_path / "t"), "--crs", "local", *options]
    )
    assert done.exit_code == 0, done.output
    assert len(read_tile(tmp_path / "t").views) == (not options)
    assert (tmp_path / "t" / "photos").exists() is not bool(options)


def test_photos_of_a_table_are_added_to_those_of_the_e57(tmp_path: Path) -> None:
    (tmp_path / "1.jpg").write_bytes(flat(80, 60)["jpegImage"])
    table = tmp_path / "photos.csv"
    table.write_text("file,x,y,z,qw,qx,qy,qz,width,height,fx\n1.jpg,1,2,3,1,0,0,0,80,60,50\n", encoding="utf-8")
    path = e57_files.write(tmp_path / "scan.e57", street(50), [GOOD])
    tile = read_tile(import_las([path], tmp_path / "tile", crs="local", photos=table))
    assert [view.photo.name for view in tile.views] == ["1.jpg", "good.jpg"]


def test_images_are_rotated_with_a_levelled_map(tmp_path: Path) -> None:
    """`scan2sim run scan.e57` rotates images with the axes of the map; the next run replaces them."""
    turn = Rotation.from_euler("XZ", [-90, 20], degrees=True)
    points = turn.apply(room().astype(np.float64))
    pose = (turn * TURN).as_quat(scalar_first=True).tolist()
    image = replace(ball((1600, 800), (360, 180)), rotation=pose, translation=turn.apply([0.5, 0.4, 0.3]).tolist())
    image, marked = drawn(image, points)
    path = e57_files.write(tmp_path / "scan.e57", points, [image])
    for _ in range(2):
        tile = read_tile(tile_of_map(path, tmp_path / "out", MapParams()))
        T = present(tile.robot_map).T_world_map
        assert T[2, 2] < 0.5  # the map was not level
        off = errors(tile, tile.views[0], marked @ T[:3, :3].T + T[:3, 3])
        assert np.isfinite(off).all() and off.max() < 0.05
    assert not read_tile(tile_of_map(path, tmp_path / "out", MapParams(images=False))).views
    assert not (tmp_path / "out" / "map" / "tile" / "photos").exists()
