"""Sign panels fitted to photos: found completely where the scan is incomplete or missing, and nowhere else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F32, F64, U8, Camera, Frame, Mesh, View
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.pipeline.furniture.classify import panel_mesh
from scan2sim.pipeline.furniture.sign_panels import SignPanel, inside
from scan2sim.pipeline.geometry import primitives
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image
from scan2sim.segmentation.labels import CLASSES
from scan2sim.segmentation.sign_panels.attach import without_smear
from scan2sim.segmentation.steps.signs import SIGNS, SignsParams
from tests.fakes.steps import step_params

FRAME = Frame("EPSG:25832", (500_000.0, 5_400_000.0, 100.0))
CAMERA = Camera("pinhole", 640, 240, 500, 500, 320, 120)
NORMAL = np.array([-np.cos(0.25), np.sin(0.25), 0.0])
SIGN = SignPanel(np.array([14.0, -3.0, 3.2]), NORMAL, "disc", 0.6, 0.6)
BELOW = SignPanel(np.array([14.0, -3.0, 2.77]), NORMAL, "rectangle", 0.42, 0.22)
WALL = 24.0
"""Metres ahead of the first photo."""
RENDERED: dict[str, list[tuple[U8, U8]]] = {}
"""Photos by the panels that they show, as JSON."""


def _views(folder: Path) -> list[View]:
    """Photos on a drive towards the sign, every 1.3 m."""
    R = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
    views = []
    for i in range(8):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, (1.3 * i - 4, 0, 1.7)
        views.append(View(f"{i}", CAMERA, T, folder / f"{i}.png"))
    return views


def _colour(shown: str | None, flat: F64, noise: F64) -> F64:
    """(N, 3) colours at points (N, 2) on a sign's face, or on the wall behind."""
    if shown is None:
        return noise[(flat[:, 0] * 12).astype(int) % 400, (flat[:, 1] * 12).astype(int) % 400]
    out = np.full((len(flat), 3), 240.0)
    radius = np.hypot(*flat.T)
    if shown == "disc":
        out[(radius > 0.21) & (radius < 0.28)] = (190, 20, 30)
        out[(np.abs(flat[:, 0]) < 0.03) & (np.abs(flat[:, 1]) < 0.12)] = 20
    else:
        out[(np.abs(flat[:, 1]) < 0.03) & (np.abs(flat[:, 0]) < 0.15)] = 20
    return out


def _photos(views: list[View], panels: list[SignPanel]) -> list[tuple[U8, U8]]:
    """`_photo` of each view: rendered once for all tests that have the same panels."""
    shown = json.dumps([panel.to_json() for panel in panels])
    if shown not in RENDERED:
        RENDERED[shown] = [_photo(view, panels) for view in views]
    return RENDERED[shown]


def _photo(view: View, panels: list[SignPanel]) -> tuple[U8, U8]:
    """A photo (H, W, 3) with four rays per pixel, and a network's probabilities at a quarter of its size."""
    import cv2

    noise = np.random.default_rng(0).uniform(20, 130, (400, 400, 1)) * [0.6, 1.0, 0.5]
    row, column = np.mgrid[: 2 * CAMERA.height, : 2 * CAMERA.width] / 2 - 0.25
    rays = np.stack([(column - CAMERA.cx) / CAMERA.fx, (row - CAMERA.cy) / CAMERA.fy, np.ones_like(row)], axis=-1)
    rays = rays.reshape(-1, 3) @ view.T_world_cam[:3, :3].T
    at = view.centre + rays * ((WALL - view.centre[0]) / rays[:, :1])
    rgb, sign = _colour(None, at[:, 1:] + 50, noise), np.zeros(len(rays), np.float32)
    for panel in panels:
        at = view.centre + rays * ((panel.centre - view.centre) @ panel.normal / (rays @ panel.normal))[:, None]
        flat = np.column_stack([(at - panel.centre) @ panel.across, at[:, 2] - panel.centre[2]])
        on = inside(flat, panel.outline, 0)
        rgb[on], sign[on] = _colour(panel.shape, flat[on], noise), 255
    size = (CAMERA.width, CAMERA.height)
    photo = cv2.resize(rgb.reshape(*row.shape, 3), size, interpolation=cv2.INTER_AREA)
    small = cv2.resize(sign.reshape(row.shape), (size[0] // 4, size[1] // 4), interpolation=cv2.INTER_AREA)
    return photo.round().astype(np.uint8), small.round().astype(np.uint8)


def _run(folder: Path, panels: list[SignPanel], known: list[SignPanel], theirs: bool = False, **params: Any) -> Done:
    """Run the step on a street with `panels`, of which `known` were found in points; the pole may be `theirs`."""
    views = _views(folder)
    labels = folder / "labels"
    labels.mkdir()
    for i, (view, (rgb, sign)) in enumerate(zip(views, _photos(views, panels), strict=True)):
        image.write(view.photo, rgb)
        probabilities = np.zeros((*sign.shape, len(CLASSES)), np.uint8)
        probabilities[..., CLASSES.index("road_sign")] = sign
        np.save(labels / f"{i}.npy", probabilities)
    views_io.save(folder / "views.json", views, [i == 5 for i in range(len(views))])
    parts = [(primitives.tube([(14.05, -3, 0), (14.05, -3, 3)], [0.04, 0.04], 8), CODE["pole"])]
    parts += [(panel_mesh(panel), CODE["road_sign"]) for panel in known]
    before = np.array([(13.8, -3.1, 3.1), (13.8, -2.9, 3.1), (13.8, -3, 3.3), (5, 9, 0), (5, 9, 3), (6, 9, 0)])
    parts += [((before, np.array([[0, 1, 2], [3, 4, 5]], np.int32)), 0)]
    vertices, faces = primitives.join([part for part, _ in parts])
    classification = np.concatenate([np.full(len(part[1]), code, np.uint8) for part, code in parts])
    Mesh(FRAME, vertices.astype(np.float32), faces, classification=classification).save(folder / "building.npz")
    flat = np.array([(-20, -20, 0), (40, -20, 0), (40, 20, 0), (-20, 20, 0)], np.float32)
    Mesh(FRAME, flat, np.array([[0, 1, 2], [0, 2, 3]], np.int32)).save(folder / "terrain.npz")
    (folder / "sign_panels.json").write_text(json.dumps([panel.to_json() for panel in known]), encoding="utf-8")
    foot = (14.05, -3.0, 0.0)
    (folder / "neighbour_poles.json").write_text(json.dumps([foot] if theirs else []), encoding="utf-8")
    place = FRAME.to_crs(foot).tolist()
    pole = {"geometry": {"coordinates": place}, "properties": {"kind": "pole", "height_m": 3.0, "radius_m": 0.04}}
    (folder / "furniture.geojson").write_text(json.dumps({"features": [] if theirs else [pole]}), encoding="utf-8")
    inputs = {f"mesh.{group}": folder / f"{group}.npz" for group in ("terrain", "building")}
    inputs |= {name: folder / f"{name}.json" for name in ("sign_panels", "neighbour_poles")} | {
        "geojson": folder / "furniture.geojson"
    }
    inputs |= {"views": folder / "views.json", "labels": labels}
    out = folder / "out"
    out.mkdir()
    return SIGNS.run(inputs, step_params(SignsParams, **params), out, silent)


def _panel_corners(done: Done) -> list[F32]:
    """Corners of each panel in the mesh, the highest first."""
    from scan2sim.segmentation.sign_panels.attach import components

    mesh = Mesh.load(done.files["building"])
    corners = [mesh.vertices[np.unique(mesh.faces[piece])] for piece in components(mesh, CODE["road_sign"])]
    return sorted(corners, key=lambda c: -float(c[:, 2].mean()))


HALF = SignPanel(np.array([14.1, -2.95, 3.05]), np.array([-1.0, 0, 0]), "rectangle", 0.55, 0.3)
"""The panel found in a scan that ends in the middle of the sign."""


BORDER_X = FRAME.origin[0] + SIGN.centre[0] + 0.2
AT_BORDER: dict[str, Any] = {
    "seed": (BORDER_X - 5, FRAME.origin[1]),
    "neighbours": {"other": (BORDER_X + 5, FRAME.origin[1])},
}
"""Cell of a tile that ends closely behind the sign."""


@pytest.mark.parametrize(
    ("known", "cell"),
    [([], AT_BORDER), ([HALF], {})],
    ids=["unscanned, at a border, on a pole of the tile", "half scanned"],
)
def test_sign_visible_in_photos_is_complete(tmp_path: Path, known: list[SignPanel], cell: dict[str, Any]) -> None:
    done = _run(tmp_path, [SIGN, BELOW], known, **cell)
    assert done.metrics == {"from_points": len(known), "fitted": 2, "new": 0 if known else 2}
    for corners, panel in zip(_panel_corners(done), [SIGN, BELOW], strict=True):
        front = corners[: len(corners) // 2]
        assert front.mean(axis=0) == pytest.approx(panel.centre, abs=0.03)
        assert np.ptp(front[:, 2]) == pytest.approx(panel.height, abs=0.03)
        assert np.ptp(front @ panel.across) == pytest.approx(panel.width, abs=0.03)
        assert np.ptp(front @ panel.normal) < 0.1
    mesh = Mesh.load(done.files["building"])
    assert mesh.classification is not None
    pole = mesh.vertices[np.unique(mesh.faces[mesh.classification == CODE["pole"]])]
    assert ((pole - SIGN.centre) @ SIGN.normal).max() < 0  # the pole is behind its panel
    assert (mesh.classification == 0).sum() == 1  # the surface in front of the panel is removed
    (feature,) = json.loads(done.files["geojson"].read_text(encoding="utf-8"))["features"]
    row = feature["properties"]
    assert row["kind"] == "sign" and row["shape"] == "disc" and row["radius_m"] == 0.04
    assert row["height_m"] == pytest.approx(3.5, abs=0.03) and row["panel_width_m"] == pytest.approx(0.6, abs=0.03)


def test_panels_at_a_border_are_not_fitted_by_the_neighbour_of_the_tile_of_their_pole(tmp_path: Path) -> None:
    done = _run(tmp_path, [SIGN, BELOW], [], theirs=True, **AT_BORDER)
    assert done.metrics["fitted"] == 0


def test_edges_on_a_border_are_kept_near_a_panel() -> None:
    x, y, z = SIGN.centre
    corners = np.array(
        [(x - 0.1, y, z), (x, y, z), (x - 0.1, y, z + 0.1), (x, y, z + 0.1), (x - 0.2, y, z)], np.float32
    )
    mesh = Mesh(FRAME, corners, np.array([[0, 1, 2], [1, 3, 2], [4, 0, 2]], np.int32))
    middle = FRAME.origin[0] + float(corners[1, 0])
    cell = Cell((middle - 5, FRAME.origin[1]), {"other": (middle + 5, FRAME.origin[1])})
    assert len(without_smear(mesh, [SIGN])) == 0
    left = without_smear(mesh, [SIGN], cell)
    assert len(left) == 1 and left.vertices[:, 0].max() == corners[1, 0]


def test_panels_from_points_are_kept_if_photos_show_none(tmp_path: Path) -> None:
    done = _run(tmp_path, [], [HALF])
    assert done.metrics["fitted"] == 0
    (corners,) = _panel_corners(done)
    assert corners.mean(axis=0) == pytest.approx(HALF.centre, abs=0.02)
