"""Colour harmonization of synthetic ground and walls in several tiles, each with its own exposure and atlas."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import cKDTree

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, I32, Frame, Mesh
from scan2sim.pipeline.geometry.coordinate_grid import snap_to_grid
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds import textured_mesh
from scan2sim.texturing.borders.colour_harmonization import ColourHarmonizationParams, colour_harmonization
from scan2sim.texturing.borders.correspondences import open_edges, shared_border
from scan2sim.texturing.borders.fading import changes, fade
from scan2sim.texturing.borders.measure import colour_step
from scan2sim.texturing.inpainting import hole_filling
from scan2sim.texturing.texel_map import corners as page_corners
from scan2sim.texturing.texel_map import owners
from tests.present import present

YS = np.append(np.arange(-3, 3, 0.3), 3)
I64: TypeAlias = npt.NDArray[np.int64]
Paint: TypeAlias = Callable[[F64], F64]
"""(N, 3) colours at points (N, 3)."""
Embedding: TypeAlias = Callable[[F64, F64], F64]
"""(N, 3) points for a sheet's own coordinates (N,) and (N,)."""
Sheet: TypeAlias = tuple[F64, F64, I64]


def paint(xyz: F64) -> F64:
    """(N, 3) grey levels of the surface at world positions: long and short waves."""
    x, y, z = np.moveaxis(np.asarray(xyz, float), -1, 0)
    wide = np.stack([np.sin(x + y), np.cos(1.3 * y - z), np.sin(0.7 * x + 2 * z)], axis=-1)
    fine = np.sin(40 * x + 9 * y) * np.sin(45 * y + 30 * z)
    return 110 + 25 * wide + 12 * fine[..., None]


def bright(xyz: F64) -> F64:
    """The surface colours in another tile's photos: brighter, tinted, and with slightly different fine detail."""
    return paint(xyz) + [24, 20, 15] + 5 * np.sin(60 * xyz[:, :1] + 50 * xyz[:, 1:2])


def plain(*rgb: float) -> Paint:
    return lambda xyz: np.broadcast_to(np.array(rgb, float), xyz.shape)


def sheet(xs: F64, ys: F64, embed: Embedding) -> Sheet:
    """A rectangle of cells: corners on the plane, their world positions, faces."""
    s, t = (a.ravel() for a in np.meshgrid(xs, ys, indexing="ij"))
    i, j = np.meshgrid(np.arange(len(xs) - 1), np.arange(len(ys) - 1), indexing="ij")
    a, n = (i * len(ys) + j).ravel(), len(ys)
    faces = np.concatenate([np.column_stack([a, a + n, a + n + 1]), np.column_stack([a, a + n + 1, a + 1])])
    return np.column_stack([s, t]), snap_to_grid(embed(s, t)), faces


def half(sign: int, cells: int, ys: F64 = YS) -> list[Sheet]:
    """Ground to the left (-1) or right (1) of a curved border, and a wall at its end."""
    xs = np.sort(sign * np.linspace(0, 7, cells + 1))

    def ground(s: F64, t: F64) -> F64:
        return np.column_stack([0.4 * np.sin(t) + s, t, 0 * t])

    def wall(s: F64, t: F64) -> F64:
        return np.column_stack([0.4 * np.sin(3) + s, 3 + 0 * s, t])

    return [sheet(xs, ys, ground), sheet(xs, np.linspace(0, 2, 7), wall)]


def flat(x0: float, x1: float, y0: float, y1: float) -> list[Sheet]:
    """Level ground."""
    xs, ys = (np.arange(a, b + 0.01, 0.25) for a, b in ((x0, x1), (y0, y1)))
    return [sheet(xs, ys, lambda s, t: np.column_stack([s, t, 0 * t]))]


def tile(
    folder: Path,
    sheets: list[Sheet],
    colour: Paint,
    *,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    texel: float = 0.03,
    turned: bool = False,
) -> Path:
    """Write a textured mesh: sheets side by side on one page, optionally rotated by 90 degrees."""
    at, right = 0, 6.3
    on_page, world, faces = [], [], []
    for plane, points, own in sheets:
        on_page.append((plane - plane.min(axis=0)) / texel + (right, 5.7))
        right += np.ptp(plane[:, 0]) / texel + 9.4
        world.append(points)
        faces.append(own + at)
        at += len(points)
    xy = np.concatenate(on_page)
    triangles: I32 = np.concatenate(faces).astype(np.int32)
    width, height = int(right) + 1, int(xy[:, 1].max()) + 8
    if turned:
        xy, width, height = np.column_stack([xy[:, 1], width - 1 - xy[:, 0]]), height, width
    uv = np.column_stack([(xy[:, 0] + 0.5) / width, 1 - (xy[:, 1] + 0.5) / height])[triangles].astype(np.float32)
    vertices = (np.concatenate(world) - origin).astype(np.float32)
    mesh = Mesh(Frame(origin=origin), vertices, triangles, uv=uv, page=np.zeros(len(triangles), np.int16))
    folder.mkdir(parents=True)
    mesh.save(folder / "mesh.npz")
    owner, rows, columns, points = texels(mesh, width, height)
    rgb, seen = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.uint8)
    rgb[rows, columns] = np.clip(np.round(colour(points)), 0, 255)
    seen[owner >= 0] = 255
    hole_filling.pad(rgb, seen, 4)
    image.write(folder / "page_0.png", rgb)
    image.write(folder / "page_0_seen.png", seen)
    return folder


def texels(mesh: Mesh, width: int, height: int) -> tuple[I32, I64, I64, F64]:
    """Owner (H, W) of a page's texels; rows, columns and world positions of those in faces."""
    corners = page_corners(present(mesh.uv), width, height)
    owner = owners(corners, width, height)
    rows, columns = np.nonzero(owner >= 0)
    points = hole_filling.texel_points(owner, corners, mesh.corners, rows, columns)
    return owner, rows, columns, points + np.asarray(mesh.frame.origin)


def run(folder: Path, neighbours: Sequence[Path] = (), **params: Any) -> tuple[Path, dict[str, Any]]:
    """Run the step on a folder; returns the folder that it writes, and its metrics."""
    out = folder.parent / f"level_{folder.name}_{len(list(folder.parent.iterdir()))}"
    out.mkdir()
    inputs = {"textured": folder, **{f"neighbour.{path.name}": path for path in neighbours}}
    done = colour_harmonization(inputs, ColourHarmonizationParams(**params), out, silent)
    return done.files["textured"], done.metrics


def step(*folders: Path) -> tuple[float, float, float]:
    return colour_step(*(present(textured_mesh.read(folder)) for folder in folders))


def same_bytes(one: Path, two: Path) -> bool:
    names = sorted(path.name for path in one.iterdir())
    assert names == sorted(path.name for path in two.iterdir())
    return all((one / name).read_bytes() == (two / name).read_bytes() for name in names)


def change(before: Path, after: Path) -> tuple[npt.NDArray[np.int64], F64]:
    """Colour change (N, 3) of the texels of faces, and their world positions (N, 3)."""
    pages = [image.read_rgb(folder / "page_0.png").astype(int) for folder in (before, after)]
    _, rows, columns, points = texels(Mesh.load(after / "mesh.npz"), *pages[0].shape[1::-1])
    return (pages[1] - pages[0])[rows, columns], points


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """Two tiles with the same border that differ in everything else."""
    one = tile(tmp_path / "one", half(-1, 20), bright)
    two = tile(tmp_path / "two", half(1, 31), paint, origin=(4.0, -2.0, 1.0), texel=0.037, turned=True)
    return one, two


def test_colour_step_between_two_tiles_disappears(pair: tuple[Path, Path]) -> None:
    one, two = pair
    mean, _, length = step(one, two)
    assert mean > 15 and length == pytest.approx(8.22, abs=0.01)  # 6.2 m of bent ground, 2 m of wall
    (left, facts), (right, _) = run(one, [two]), run(two, [one])
    mean, p95, _ = step(left, right)
    assert mean < 1 and p95 < 3
    assert facts["border_m"] == pytest.approx(length, abs=0.01)
    assert facts["step_before"] > 15 and facts["step_after"] < 1 and facts["step_p95_after"] < 3
    assert facts["neighbours"]["two"]["border_m"] == facts["border_m"]


def test_texels_beyond_the_fade_distance_are_unchanged(pair: tuple[Path, Path]) -> None:
    one, two = pair
    harmonized, _ = run(one, [two], fade_distance=1.5)
    added, points = change(one, harmonized)
    border = shared_border([open_edges(Mesh.load(folder / "mesh.npz")) for folder in pair]).xyz
    distance, _ = cKDTree(border).query(points)
    assert (added[distance > 1.55] == 0).all() and (distance > 1.55).mean() > 0.5
    assert (abs(added[distance < 0.3]).max(axis=1) > 3).mean() > 0.95
    for name in ("mesh.npz", "page_0_seen.png"):
        assert (harmonized / name).read_bytes() == (one / name).read_bytes()


def test_correction_fades_monotonically(tmp_path: Path) -> None:
    one, two = tile(tmp_path / "a", flat(-6, 0, -3, 3), plain(120, 90, 60)), tmp_path / "b"
    tile(two, flat(0, 6, -3, 3), plain(100, 90, 80))
    added, points = change(one, run(one, [two])[0])
    row = abs(points[:, 1]) < 0.02
    by_x = added[row][np.argsort(points[row, 0])]
    assert by_x[0].tolist() == [0, 0, 0] and by_x[-1].tolist() == [-10, 0, 10]
    for channel, sign in ((0, -1), (2, 1)):
        rise = np.diff(sign * by_x[:, channel])
        assert rise.min() >= 0 and rise.max() <= 1
    assert (added[:, 1] == 0).all()


def test_no_colour_step_where_three_tiles_meet(tmp_path: Path) -> None:
    tiles = {
        "a": tile(tmp_path / "a", flat(-4, 0, -4, 4), plain(140, 110, 100)),
        "b": tile(tmp_path / "b", flat(0, 4, 0, 4), plain(110, 110, 100), texel=0.026, turned=True),
        "c": tile(tmp_path / "c", flat(0, 4, -4, 0), plain(95, 90, 130), texel=0.034),
    }
    done = {name: run(path, [p for p in tiles.values() if p != path])[0] for name, path in tiles.items()}
    for one, two in ("ab", "bc", "ca"):
        assert step(done[one], done[two])[0] < 1
    for name, folder in done.items():  # no step within a tile, not even around the corner
        page = image.read_rgb(folder / "page_0.png").astype(int)
        owner = texels(Mesh.load(folder / "mesh.npz"), *page.shape[1::-1])[0]
        for axis in (0, 1):
            inside = (np.minimum(owner, np.roll(owner, 1, axis)) >= 0)[1:, 1:]
            assert abs(np.diff(page, axis=axis))[-inside.shape[0] :, -inside.shape[1] :][inside].max() <= 2, name
        added, points = change(tiles[name], folder)
        here = np.linalg.norm(points[:, :2], axis=1).argmin()
        assert abs(added[here] + image.read_rgb(tiles[name] / "page_0.png")[8, 8] - [115, 103, 110]).max() <= 2


def test_shared_vertices_without_shared_edges_are_sufficient(tmp_path: Path) -> None:
    one = tile(tmp_path / "one", half(-1, 20), bright)
    two = tile(tmp_path / "two", half(1, 20, YS[::2]), paint)
    assert step(one, two)[0] > 15
    assert step(run(one, [two])[0], run(two, [one])[0])[0] < 1


def test_a_short_border_changes_little(tmp_path: Path) -> None:
    one = tile(tmp_path / "one", flat(-4, 0, -4, 4), plain(120, 120, 120))
    two = tile(tmp_path / "two", flat(0, 4, 4, 8), plain(120, 120, 120))  # touches at one vertex
    tile(tmp_path / "three", flat(0, 0.5, 0, 0.25), plain(80, 80, 80))  # along one edge
    assert step(one, two) == (0, 0, 0)
    added, points = change(one, run(one, [two, tmp_path / "three"])[0])
    distance = np.linalg.norm(points - [0, 0.125, 0], axis=1)
    assert abs(added[distance < 0.05] + 20).max() <= 3
    assert abs(added[distance > 1.5]).max() <= 4


def test_tree_code_equals_direct_summation() -> None:
    rng = np.random.default_rng(0)
    y = np.arange(0, 4, 0.015)
    points = np.column_stack([0.3 * np.sin(y), y, 0 * y])
    value = (20 * np.sin(2 * y)[:, None] + rng.normal(0, 10, (len(y), 3))).astype(np.float32)
    corners = np.array([[[0, 0, 0], [2, 0, 0], [0, 4, 0]]], np.float32)
    on_page = np.array([[[0, 0], [100, 0], [0, 200]]], np.float32)
    owner, page = owners(on_page, 101, 201), np.full((201, 101, 3), 128, np.uint8)
    tree = changes(points, np.full(len(y), 0.015), value)
    fade(page, owner, on_page, corners, np.ones(1, bool), tree, 3.0)
    rows, columns = np.nonzero(owner >= 0)
    at = np.column_stack([columns * 0.02, rows * 0.02, 0 * rows])
    distance2 = ((at[:, None] - points) ** 2).sum(axis=2)
    weight = 0.015 / (distance2 + 0.0075**2) ** 2
    nearest = distance2.min(axis=1)
    near = np.maximum(0, 1 - np.sqrt(nearest) / 3)
    share = np.minimum(1, weight.sum(axis=1) * (nearest + 0.0075**2) ** 1.5 * 4 / np.pi) * near**2 * (3 - 2 * near)
    direct = share[:, None] * (weight @ value) / weight.sum(axis=1)[:, None]
    error = abs(page[rows, columns] - (128 + direct))
    assert error.mean() < 0.3 and error.max() < 1.5  # rounding, and far points merged into nodes of the tree


def test_results_are_byte_identical_when_repeated(pair: tuple[Path, Path]) -> None:
    assert same_bytes(run(pair[0], [pair[1]])[0], run(pair[0], [pair[1]])[0])


def test_tile_without_neighbours_is_unchanged(pair: tuple[Path, Path], tmp_path: Path) -> None:
    one, _ = pair
    empty, far = tmp_path / "empty", tile(tmp_path / "far", flat(50, 52, 0, 2), paint)
    empty.mkdir()
    Mesh(Frame(), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)).save(empty / "mesh.npz")
    for neighbours in ([], [empty], [far, empty]):
        folder, facts = run(one, neighbours)
        assert same_bytes(folder, one) and facts["border_m"] == 0
    folder, facts = run(empty, [one])
    assert same_bytes(folder, empty) and facts["border_m"] == 0


def test_inputs_are_not_modified(pair: tuple[Path, Path]) -> None:
    before = {path: path.read_bytes() for folder in pair for path in folder.iterdir()}
    run(pair[0], [pair[1]])
    assert all(path.read_bytes() == content for path, content in before.items())


def test_unreadable_page_of_a_neighbour_is_reported(pair: tuple[Path, Path]) -> None:
    (pair[1] / "page_0.png").write_bytes(b"broken")
    with pytest.raises(InputError, match=r"two/page_0\.png"):
        run(pair[0], [pair[1]])


def test_padding_follows_the_changed_charts(pair: tuple[Path, Path]) -> None:
    page = cv2.imread(str(run(pair[0], [pair[1]])[0] / "page_0.png"))[..., ::-1]
    seen = cv2.imread(str(pair[0] / "page_0_seen.png"), cv2.IMREAD_GRAYSCALE)
    padded = np.ascontiguousarray(page)
    hole_filling.pad(padded, seen, 4)
    around = cv2.dilate(seen, np.ones((5, 5), np.uint8)) > 0
    assert (padded[around] == page[around]).all()
