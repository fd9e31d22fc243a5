"""A corridor cut into tiles: no point is lost, neighbours have identical points, and memory is constant."""

from __future__ import annotations

import gc
import shutil
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import pytest
import tomli_w

from scan2sim.pipeline.core.errors import DataError, InputError, SettingError
from scan2sim.pipeline.core.types import Camera, Frame, PointCloud, Tile, Trajectory
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.survey import Survey, read_survey
from scan2sim.pipeline.io.tile import read_tile, write_tile
from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey
from scan2sim.pipeline.tiling.cut_plan import seeds, tile_membership
from tests.present import present

UTM = Frame("EPSG:32632", (690_000.0, 5_335_000.0, 500.0))
FEET = Frame("EPSG:2994", (200_000.0, 300_000.0, 30.0), 0.3048)
RADIUS, ANGLE = 200.0, 1.5  # of the street, which bends to the left, 300 m long
CUT = CutParams(length=100, buffer=5, max_distance=20)
CAMERA = Camera("pinhole", 64, 48, 32.0, 32.0, 31.5, 23.5)


def street(along: np.ndarray, aside: np.ndarray) -> np.ndarray:
    """(N, 2) local positions, from metres along the street and to the right of its middle."""
    a = along / RADIUS
    return np.column_stack([(RADIUS + aside) * np.sin(a), RADIUS - (RADIUS + aside) * np.cos(a)])


def drive(*, back: bool = True) -> np.ndarray:
    """(T, 4) time, x, y, z over and, 4 m to the left, back."""
    over = street(np.arange(0, RADIUS * ANGLE + 0.1, 0.5), np.zeros(601))
    there = street(np.arange(0, RADIUS * ANGLE + 0.1, 0.5), np.full(601, -4.0))[::-1]
    xy = np.concatenate([over, there]) if back else over
    return np.column_stack([100 + np.arange(len(xy)) / 20, xy, np.full(len(xy), 2.0)])


def points(n: int = 200_000, seed: int = 0, frame: Frame = UTM) -> PointCloud:
    """Points of a street with all attributes, beyond the maximum distance from the path."""
    rng = np.random.default_rng(seed)
    along = np.sort(rng.uniform(0, RADIUS * ANGLE, n))
    xy = street(along, rng.uniform(-26, 26, n))
    return PointCloud(
        frame,
        np.column_stack([xy, rng.uniform(0, 8, n)]).astype(np.float32),
        rng.integers(0, 256, (n, 3)).astype(np.uint8),
        classification=rng.choice([2, 6, 69], n).astype(np.uint8),
        time=100 + along / 10,
        intensity=rng.integers(0, 65536, n).astype(np.uint16),
    )


def facing(along: float, aside: float = 0.0) -> dict[str, Any]:
    """A photo's pose, looking along the street."""
    (x, y), a = street(np.array([along]), np.array([aside]))[0], along / RADIUS
    forward, right = np.array([np.cos(a), np.sin(a), 0]), np.array([np.sin(a), -np.cos(a), 0])
    rotation = np.column_stack([right, [0, 0, -1], forward])
    return {"position": UTM.to_crs([x, y, 2.0]), "rotation": rotation, "camera": "front"}


def corridor(
    folder: Path, frame: Frame = UTM, n: int = 200_000, path: np.ndarray | None = None, **more: object
) -> Path:
    """Write the street's tile folder, with its cloud in three files."""
    folder.mkdir(parents=True)
    cloud = points(n, frame=frame)
    for i, part in enumerate(np.array_split(np.arange(n), 3)):
        las.write(folder / f"{i}.laz", cloud.take(part), 0.001 * frame.unit)
    path = drive() if path is None else path
    rows = np.column_stack([path[:, 0], frame.to_crs(path[:, 1:])])
    np.savetxt(folder / "path.csv", rows, "%.4f", ",", header="time,x,y,z", comments="")
    options: dict[str, Any] = {
        "name": "bend",
        "crs": frame.crs,
        "clouds": [f"{i}.laz" for i in range(3)],
        "cameras": {},
    }
    write_tile(folder, **(options | {"trajectory": "path.csv"} | more))
    return folder


@pytest.fixture(scope="module")
def bend(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The street with photos: at 10 m forward, at 290 m forward, at 95 m, and one whose file is missing."""
    folder = tmp_path_factory.mktemp("bend") / "corridor"
    photos = [{"file": f"photos/{along}.jpg", **facing(along)} for along in (10, 95, 290)]
    photos.append({"file": "photos/lost.jpg", **facing(200)})
    photos[1] |= {"mask": "mask.png", "time": 105.0}
    corridor(folder, cameras={"front": CAMERA}, photos=photos)
    (folder / "photos").mkdir()
    for photo in photos[:3]:
        cv2.imwrite(str(folder / photo["file"]), np.zeros((48, 64, 3), np.uint8))
    cv2.imwrite(str(folder / "mask.png"), np.full((48, 64), 255, np.uint8))
    return folder


@pytest.fixture(scope="module")
def cut(bend: Path) -> Path:
    """The street, cut into three."""
    return cut_survey(bend, bend.parent / "survey", CUT)


def tiles(survey: Path) -> dict[str, Tile]:
    return {tile.name: tile for tile in map(read_tile, read_survey(survey).tiles.values())}


def rows(files: Iterator[Path] | list[Path], frame: Frame) -> np.ndarray:
    """(N,) records of all points of files, in their order: thousandths of CRS units, and attributes."""
    kinds = [("place", "<i8", 3), ("rgb", "u1", 3), ("classification", "u1"), ("time", "f8"), ("intensity", "u2")]
    out = []
    for file in files:
        raw = laspy.read(file)
        some = np.zeros(len(raw.points), kinds)
        some["place"] = np.rint(np.column_stack([raw.x, raw.y, raw.z]) * 1000)
        cloud = las.read(file, frame)
        for name in ("rgb", "classification", "time", "intensity"):
            if getattr(cloud, name) is not None:
                some[name] = getattr(cloud, name)
        out.append(some)
    return np.concatenate(out)


def shares(source: np.ndarray, places: np.ndarray, unit: float, buffer: float) -> tuple[np.ndarray, np.ndarray]:
    """Own tile (N,) of each point, and mask (N, S) of tiles that contain it, by exhaustive search over seeds."""
    xy = source["place"][:, :2] / 1000 * unit
    squared = ((xy[:, None] - places) ** 2).sum(axis=2)
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    holds = np.ones(squared.shape, bool)
    for j in range(len(places)):
        for k in range(len(places)):
            if k != j:
                holds[:, j] &= (squared[:, j] - squared[:, k]) / (2 * apart[j, k]) <= buffer
    return np.argmin(squared, axis=1), holds


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def leftovers(folder: Path) -> list[str]:
    """Names of files that a failed run left next to the corridor."""
    return sorted(p.name for p in folder.iterdir() if p.name != "corridor")


# seeds


def path_of(*corners: tuple[float, float], step: float = 1.0) -> Trajectory:
    legs = []
    for a, b in pairwise(corners):
        n = max(1, round(np.hypot(b[0] - a[0], b[1] - a[1]) / step))
        legs.append(np.array(a) + np.subtract(b, a) * np.arange(n)[:, None] / n)
    xy = np.concatenate([*legs, [corners[-1]]])
    return Trajectory(np.arange(len(xy), dtype=float) * 0.1, np.column_stack([xy, np.zeros(len(xy))]))


def placed(path: Trajectory, length: float = 100.0) -> np.ndarray:
    return np.array(list(seeds("s", Frame(), length, (0, 0), (1, 1), path).values()))


@pytest.mark.parametrize("metres", [1000, 1030, 960])
def test_straight_path_is_cut_evenly(metres: int) -> None:
    made = seeds("s", Frame(), 100.0, (0, 0), (1, 1), path_of((0, 0), (metres, 0)))
    assert list(made) == [f"s_{i:04d}" for i in range(10)]
    assert np.allclose(list(made.values()), [((i + 0.5) * metres / 10, 0) for i in range(10)], atol=0.001)


def test_repeated_passes_and_the_other_lane_add_no_seeds() -> None:
    once = placed(path_of((0, 0), (1000, 0)))
    over_and_back = [(0.0, 0.0), (1000.0, 0.0), (1000.0, 5.0), (0.0, 5.0)]
    again = placed(path_of(*over_and_back, *over_and_back))
    assert again.shape == once.shape and np.abs(again - once).max() < 10


def test_seeds_in_a_town_are_about_a_tile_length_apart() -> None:
    rng = np.random.default_rng(0)
    at, corners = np.zeros(2), [(0.0, 0.0)]
    for _ in range(300):
        turn = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])[rng.integers(4)]
        at = np.clip(at + turn, -4, 4)
        corners.append((float(at[0] * 120), float(at[1] * 80)))
    path = path_of(*corners)
    made = placed(path)
    apart = np.linalg.norm(made[:, None] - made, axis=2) + 1e9 * np.eye(len(made))
    assert apart.min() >= 75 - 0.01 and apart.min(axis=1).max() < 150
    assert np.linalg.norm(path.positions[:, None, :2] - made, axis=2).min(axis=1).max() <= 100


def test_gap_in_the_path_is_reported() -> None:
    first, second = path_of((0, 0), (300, 0)), path_of((400, 0), (700, 0))
    path = Trajectory(
        np.concatenate([first.times, 60 + second.times]), np.concatenate([first.positions, second.positions])
    )
    warned: list[str] = []
    made = seeds("s", Frame(), 100.0, (0, 0), (1, 1), path, warned.append)
    assert [x for x, _ in made.values()] == [50, 150, 250, 450, 550, 650]
    assert len(warned) == 1 and "gap of 100 m from 30.000 s to 60.000 s, at 300.0, 0.0" in warned[0]


@pytest.mark.parametrize("path", [path_of((0, 0), (30, 0)), path_of((15, 0), (15, 0))])
def test_short_path_is_one_tile(path: Trajectory) -> None:
    assert np.allclose(placed(path), [(15, 0)])


def test_standing_still_does_not_lengthen_the_path() -> None:
    rng = np.random.default_rng(0)
    path = path_of((0, 0), (300, 0))
    still = path.positions[150] + np.column_stack([rng.normal(0, 0.05, (5000, 2)), np.zeros(5000)])
    xyz = np.insert(path.positions, 150, still, axis=0)
    assert np.allclose(placed(Trajectory(np.arange(len(xyz), dtype=float) * 0.1, xyz)), placed(path), atol=0.5)


def test_seeds_without_a_path_are_on_a_grid() -> None:
    made = seeds("s", Frame(), 50.0, (0, 0), (110, 95))
    assert list(made.values()) == [(30, 22.5), (80, 22.5), (30, 72.5), (80, 72.5)]
    assert list(seeds("s", Frame(), 500.0, (0, 0), (110, 95)).values()) == [(55, 47.5)]
    many = list(seeds("s", Frame(), 1.0, (0, 0), (110, 95)))
    assert len(many) == 10_450 and many == sorted(many)
    with pytest.raises(DataError, match="100,000,000 tiles"):
        seeds("s", Frame(), 100.0, (0, 0), (1e6, 1e6))


def test_seeds_are_rounded_to_thousandths_of_the_unit() -> None:
    path = replace(path_of((0.1234567, 0.7), (333.3, 71.1)))
    for x, y in seeds("s", FEET, 100.0, (0, 0), (1, 1), path).values():
        assert (round(x / 0.3048, 3) * 0.3048, round(y / 0.3048, 3) * 0.3048) == (x, y)


@pytest.mark.parametrize("buffer", [0.0, 3.0, 20.0])
def test_tile_membership_equals_exhaustive_search(buffer: float) -> None:
    rng = np.random.default_rng(4)
    places, xy = rng.uniform(0, 300, (40, 2)), rng.uniform(-50, 350, (3000, 2))
    source = np.zeros(len(xy), [("place", "f8", 3)])
    source["place"][:, :2] = xy * 1000
    nearest, holds = shares(source, places, 1.0, buffer)
    own, also, others = tile_membership(xy, places, buffer)
    assert np.array_equal(own, nearest)
    mine = np.zeros_like(holds)
    mine[np.arange(len(xy)), own] = True
    assert not mine[also, others].any()
    mine[also, others] = True
    assert np.array_equal(mine, holds)


# points


def test_tiles_contain_exactly_their_points_without_changes(bend: Path, cut: Path) -> None:
    made = tiles(cut)
    assert list(made) == ["bend_0000", "bend_0001", "bend_0002"]
    source = rows([bend / f"{i}.laz" for i in range(3)], UTM)
    path = drive()[:, 1:3] + UTM.origin[:2]
    distance = np.linalg.norm(source["place"][::40, None, :2] / 1000 - path[::4], axis=2).min(axis=1)
    places = np.array([tile.cell.seed for tile in made.values() if tile.cell])
    own, holds = shares(source, places, 1.0, 5.0)
    total = 0
    for j, tile in enumerate(made.values()):
        got = rows(list(tile.clouds), UTM)
        wanted = source[holds[:, j]]
        kept = np.isin(wanted["place"] @ [1, 10**9, 7], got["place"] @ [1, 10**9, 7])
        assert np.array_equal(got, wanted[kept])  # equal points, attributes and order
        total += int(np.count_nonzero(kept & (own[holds[:, j]] == j)))
        some = np.flatnonzero(holds[::40, j])
        near = np.isin(source["place"][::40][some] @ [1, 10**9, 7], got["place"] @ [1, 10**9, 7])
        assert near[distance[some] < 19.5].all() and not near[distance[some] > 20.1].any()
    assert 0.7 * len(source) < total < 0.9 * len(source)  # each point is in the own part of one tile
    union = np.unique(np.concatenate([rows(list(tile.clouds), UTM) for tile in made.values()]))
    assert len(union) == total


def test_tiles_contain_their_cells(cut: Path) -> None:
    made = tiles(cut)
    survey = read_survey(cut.parent)
    assert survey == Survey(cut, "bend", {name: cut.parent / name / "tile.toml" for name in made}, 100.0, 5.0)
    for name, tile in made.items():
        assert tile.cell is not None and tile.frame.crs == "EPSG:32632"
        for other, seed in tile.cell.neighbours.items():
            cell = made[other].cell
            assert cell is not None and cell.seed == seed and cell.neighbours[name] == tile.cell.seed
        xyz = clouds.read(tile.clouds[0], tile.frame).xyz.astype(np.float64) + tile.frame.origin
        assert 4.9 < tile.cell.outside(xyz[:, :2]).max() <= 5 + 1e-3
        assert tile.cell.buffer == 5.0 and set(tile.cell.neighbours) == set(made) - {
            name
        }  # all neighbours, in the bend


def test_tiles_get_the_part_of_the_path_that_scanned_them(cut: Path) -> None:
    for tile in tiles(cut).values():
        assert tile.trajectory is not None
        assert 200 < len(tile.trajectory) < 1000 and (np.diff(tile.trajectory.times) > 0).all()
        xyz = clouds.read(tile.clouds[0], tile.frame).xyz
        near = tile.trajectory.positions[:, :2]
        assert (near >= xyz[:, :2].min(axis=0) - 20.01).all() and (near <= xyz[:, :2].max(axis=0) + 20.01).all()


def test_photos_are_assigned_to_the_tiles_that_they_see(bend: Path, cut: Path) -> None:
    seen = {name: [view.photo.name for view in tile.views] for name, tile in tiles(cut).items()}
    # at 95 m a camera is in the first tile and sees the second, at 200 m it is on a border and faces away from
    # the second, and at 290 m it looks out of the last one
    assert seen == {"bend_0000": ["10.jpg", "95.jpg"], "bend_0001": ["95.jpg"], "bend_0002": ["290.jpg", "lost.jpg"]}
    view = tiles(cut)["bend_0001"].views[0]
    source = read_tile(bend)
    assert view.photo.resolve() == (bend / "photos/95.jpg").resolve()
    assert view.mask is not None and view.mask.samefile(bend / "mask.png")
    assert view.time == 105.0 and view.camera == CAMERA
    frame = tiles(cut)["bend_0001"].frame
    assert np.allclose(frame.to_crs(view.centre), source.frame.to_crs(source.views[1].centre), atol=1e-6)


def test_photos_are_copied_on_request(bend: Path, tmp_path: Path) -> None:
    warned: list[str] = []
    survey = cut_survey(bend, tmp_path / "out", CUT.model_copy(update={"copy_photos": True}), warn=warned.append)
    view = tiles(survey)["bend_0001"].views[0]
    assert view.photo == tmp_path / "out/bend_0001/photos/95.jpg" and view.photo.is_file()
    assert view.mask == tmp_path / "out/bend_0001/masks/mask.png" and view.mask.is_file()
    assert any("1 of 4 photos are missing" in text and "lost.jpg" in text for text in warned)


def test_cut_is_deterministic(bend: Path, cut: Path) -> None:
    assert contents(cut_survey(bend, bend.parent / "again", CUT).parent) == contents(cut.parent)
    with laspy.open(cut.parent / "bend_0000/cloud.laz") as reader:
        assert reader.header.creation_date == las.CREATION_DATE == date(2000, 1, 1)


@pytest.mark.parametrize("frame", [FEET, Frame("local", (50.0, 60.0, 7.0)), Frame("local", (0.0, 0.0, 0.0), 0.3048)])
def test_surveys_in_feet_and_local_coordinates_are_cut(tmp_path: Path, frame: Frame) -> None:
    units = "ft" if frame.crs == "local" and frame.unit != 1 else None
    source = corridor(tmp_path / "corridor", frame, 20_000, units=units)
    made = tiles(cut_survey(source, tmp_path / "out", CUT))
    assert len(made) == 3
    given = rows([source / f"{i}.laz" for i in range(3)], frame)
    places = np.array([tile.cell.seed for tile in made.values() if tile.cell])
    _, holds = shares(given, places, frame.unit, 5.0)
    for j, tile in enumerate(made.values()):
        assert (tile.frame.crs, tile.frame.unit) == (frame.crs, frame.unit)
        got = rows(list(tile.clouds), frame)["place"]
        index = {tuple(place): i for i, place in enumerate(got.tolist())}
        wanted = [tuple(place) for place in given["place"][holds[:, j]].tolist()]
        assert sum(place in index for place in wanted) == len(got)


def test_tiles_without_a_trajectory_are_squares_with_common_corners(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(0, 100, (20_000, 2)), rng.uniform(0, 5, 20_000)]).astype(np.float32)
    las.write(tmp_path / "a.laz", PointCloud(UTM, xyz))
    write_tile(tmp_path / "corridor", name="field" * 20, crs=UTM.crs, clouds=["../a.laz"], cameras={})
    made = tiles(cut_survey(tmp_path / "corridor", tmp_path / "out", CutParams(length=50)))
    assert len(made) == 4 and all(name.startswith("field" * 17) for name in made), "names have room for a number"
    for name, tile in made.items():
        assert tile.cell is not None and list(tile.cell.neighbours) == sorted(set(made) - {name})
        assert tile.trajectory is None and 5500 < len(clouds.read(tile.clouds[0], tile.frame)) < 6600  # 55 m square


def test_clouds_with_different_attributes_are_joined(tmp_path: Path) -> None:
    cloud = points(30_000)
    folder = corridor(tmp_path / "corridor", n=30_000)
    las.write(folder / "1.laz", replace(cloud.take(slice(10_000, 20_000)), rgb=None))
    xyz = UTM.to_crs(cloud.xyz[20_000:])
    heading = "".join(f"property double {k}\n" for k in "xyz")
    text = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{heading}end_header\n"
    xyz[5] = np.nan
    (folder / "2.ply").write_bytes(text.encode() + xyz.astype("<f8").tobytes())
    body = {"name": "bend", "crs": UTM.crs, "clouds": ["0.laz", "1.laz", "2.ply"], "trajectory": "path.csv"}
    (folder / "tile.toml").write_text(tomli_w.dumps(body), encoding="utf-8")
    warned: list[str] = []
    made = tiles(cut_survey(folder, tmp_path / "out", CUT, warn=warned.append))
    assert "2.ply: 1 points with NaN coordinates removed" in warned
    first, middle, last = (clouds.read(tile.clouds[0], tile.frame) for tile in made.values())
    assert first.time is not None and first.intensity is not None and np.any(first.rgb != 128)
    assert middle.rgb is not None and (middle.rgb == 128).all(axis=1).mean() > 0.5
    assert last.time is None and (present(last.intensity) == 0).mean() > 0.5  # the PLY has neither
    assert set(np.unique(present(last.classification))) == {1, 2, 6, 69}


def test_chunks_equal_the_whole_cloud(tmp_path: Path) -> None:
    cloud = points(30_000)
    dark = np.where(np.arange(30_000)[:, None] < 25_000, 0, present(cloud.rgb))
    for rgb in (cloud.rgb, dark.astype(np.uint8), np.zeros_like(dark, np.uint8), None):
        las.write(tmp_path / "c.laz", replace(cloud, rgb=rgb))
        whole = las.read(tmp_path / "c.laz", UTM)
        parts = list(clouds.chunks(tmp_path / "c.laz", UTM, 7_000))
        assert [len(part) for part in parts] == [7_000] * 4 + [2_000]
        moved = [replace(p, frame=UTM, xyz=UTM.to_local(p.frame.to_crs(p.xyz)).astype(np.float32)) for p in parts]
        joined = PointCloud.join(moved)
        assert np.abs(joined.xyz - whole.xyz).max() < 1e-4
        for name in ("rgb", "classification", "time", "intensity"):
            assert np.array_equal(getattr(joined, name), getattr(whole, name)), name


# errors


def test_clouds_in_two_crs_are_rejected_unless_the_tile_names_one(tmp_path: Path) -> None:
    folder = corridor(tmp_path / "corridor", n=3_000)
    las.write(folder / "1.laz", replace(points(1_000), frame=replace(UTM, crs="EPSG:2154")))
    notes: list[str] = []
    cut_survey(folder, tmp_path / "named", CUT, warn=notes.append)
    assert any("1.laz: its header says EPSG:2154; EPSG:32632 is used" in note for note in notes)
    text = (folder / "tile.toml").read_text(encoding="utf-8")
    (folder / "tile.toml").write_text(text.replace('crs = "EPSG:32632"', ""), encoding="utf-8")
    with pytest.raises(InputError, match=r"1\.laz: is in EPSG:2154, but 0\.laz is in EPSG:32632"):
        cut_survey(folder, tmp_path / "out", CUT)
    assert leftovers(tmp_path) == ["named"]


def test_truncated_cloud_is_reported_and_leaves_no_files(tmp_path: Path) -> None:
    folder = corridor(tmp_path / "corridor", n=30_000)
    whole = (folder / "1.laz").read_bytes()
    (folder / "1.laz").write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(InputError, match=r"1\.laz.*Copy"):
        cut_survey(folder, tmp_path / "out", CUT)
    assert leftovers(tmp_path) == []


def test_interruption_leaves_no_files(tmp_path: Path) -> None:
    def stop(fraction: float, message: str = "") -> None:
        if fraction > 0.7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cut_survey(corridor(tmp_path / "corridor", n=20_000), tmp_path / "out", CUT, report=stop)
    assert leftovers(tmp_path) == []


def test_only_a_survey_is_overwritten_and_only_on_request(tmp_path: Path) -> None:
    folder = corridor(tmp_path / "corridor", n=20_000)
    cut_survey(folder, tmp_path / "out", CUT)
    with pytest.raises(SettingError, match="exists and is not empty"):
        cut_survey(folder, tmp_path / "out", CUT)
    assert (
        len(tiles(cut_survey(folder, tmp_path / "out", CUT.model_copy(update={"length": 150.0}), overwrite=True))) == 2
    )
    with pytest.raises(SettingError, match="contains the corridor"):
        cut_survey(folder, folder, CUT, overwrite=True)
    shutil.copytree(folder, tmp_path / "other")
    with pytest.raises(SettingError, match="is not a survey"):
        cut_survey(folder, tmp_path / "other", CUT, overwrite=True)
    with pytest.raises(InputError, match="was already cut from a survey"):
        cut_survey(tmp_path / "out/bend_0000", tmp_path / "more", CUT)


@pytest.mark.parametrize(
    ("options", "field"),
    [({"length": 0}, "length"), ({"buffer": -1}, "buffer"), ({"length": 10, "buffer": 6}, "buffer"),
     ({"max_distance": float("nan")}, "max-distance"), ({"photo_distance": -1}, "photo-distance")],
)  # fmt: skip
def test_options_out_of_range_are_rejected(tmp_path: Path, options: dict[str, float], field: str) -> None:
    with pytest.raises(SettingError, match=field):
        cut_survey(tmp_path, tmp_path / "out", CutParams.of("", options))


def test_tiles_with_few_points_are_merged_into_neighbours(tmp_path: Path) -> None:
    xy = street(np.arange(0, 500, 0.5), np.zeros(1000))  # the path continues where there are no clouds
    path = np.column_stack([np.arange(1000) / 20, xy, np.full(1000, 2.0)])
    folder = corridor(tmp_path / "corridor", n=20_000, path=path)
    warned: list[str] = []
    made = tiles(cut_survey(folder, tmp_path / "out", CUT, warn=warned.append))
    assert list(made) == ["bend_0000", "bend_0001", "bend_0002"]
    assert any(
        "2 of 5 tiles have fewer than 1,000 points" in text and "bend_0003, bend_0004" in text for text in warned
    )
    assert all(name in made for tile in made.values() for name in (tile.cell.neighbours if tile.cell else ()))


def test_trajectory_far_from_the_points_is_an_error(tmp_path: Path) -> None:
    path = drive()
    path[:, 1] += 5000
    folder = corridor(tmp_path / "corridor", n=20_000, path=path)
    with pytest.raises(DataError, match=r"only 0 points, and 20,000 farther than 20 m.*CRS of clouds and trajectory"):
        cut_survey(folder, tmp_path / "out", CUT)
    assert leftovers(tmp_path) == []


def test_invalid_surveys_are_rejected_with_their_cause(tmp_path: Path) -> None:
    out = cut_survey(corridor(tmp_path / "corridor", n=20_000), tmp_path / "out", CUT)
    text = out.read_text(encoding="utf-8")
    with pytest.raises(InputError, match="no survey found"):
        read_survey(tmp_path)
    for old, new, cause in (
        ("length = 100.0", "lenght = 100.0", "field `length`: Field required"),
        ("length = 100.0", "length = -1.0", "field `length`"),
        ("length = 100.0", "length = ", "is not valid TOML"),
        ("bend_0001", "bend_0009", "bend_0009.*file not found"),
        ("bend_0001", "bend_0000", "names two tiles bend_0000"),
    ):
        out.write_text(text.replace(old, new), encoding="utf-8")
        with pytest.raises(InputError, match=cause):
            read_survey(out)
    out.write_text(text, encoding="utf-8")
    other = tmp_path / "out/bend_0001/tile.toml"
    tile = other.read_text(encoding="utf-8")
    other.write_text(tile.replace('"bend_0001"', '"Bend_0000"'), encoding="utf-8")
    with pytest.raises(InputError, match="names two tiles Bend_0000"):
        read_survey(out)
    other.write_text(tile.replace("EPSG:32632", "EPSG:32633"), encoding="utf-8")
    with pytest.raises(InputError, match=r"two CRS: bend_0001 is in EPSG:32633, bend_0000 in EPSG:32632"):
        read_survey(out)


# memory


def test_memory_is_independent_of_the_number_of_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = corridor(tmp_path / "corridor", n=6_000)
    part = points(20_000)
    monkeypatch.setattr("scan2sim.pipeline.tiling.point_spool.CHUNK_POINTS", 20_000)

    def chunks(count: int) -> Iterator[PointCloud]:
        for _ in range(count):
            gc.collect()  # otherwise it would depend on the tests before when cycles that hold arrays are freed
            yield part

    def peak(parts: int) -> int:
        monkeypatch.setattr(clouds, "chunks", lambda *_: chunks(parts))
        tracemalloc.start()
        cut_survey(folder, tmp_path / "out", CUT, overwrite=True)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    peak(1)  # data that is loaded once
    assert peak(20) < 1.5 * peak(2)  # of each of three files
