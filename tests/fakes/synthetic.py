"""A made-up textured tile: bumpy ground (two pages) and a house (two pages)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scan2sim.pipeline.camera.renderer import look_at, pinhole
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Frame, Mesh, Trajectory, View
from scan2sim.pipeline.geometry.primitives import tube
from scan2sim.pipeline.io.geodata import geojson
from scan2sim.pipeline.io.worlds.scene import PATH_FILE, Scene, read_scene, save_tile, write_scene_file
from scan2sim.pipeline.io.worlds.textured_mesh import save_reflectance
from scan2sim.pipeline.steps.collision import COLLISION, CollisionParams
from scan2sim.pipeline.steps.decimate import with_furniture
from scan2sim.pipeline.steps.export import EXPORT, ExportParams
from tests.fakes.steps import step_params

UTM = Frame("EPSG:32632", (690_000.0, 5_335_000.0, 500.0))
REFLECTANCE = {"terrain": 0.2, "building": 0.6}
"""Reflectance of the surfaces of a scene; multiples of 1/255."""
HOUSE = (4.0, 2.0)  # its corner of least x and y; it measures 3 x 2 x 5 m


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of the ground at (x, y), metres."""
    return 0.3 * np.sin(x / 3) * np.cos(y / 4)


def ground(cells: int = 40, frame: Frame = UTM) -> Mesh:
    """20 x 20 m around the origin; u follows x, v follows y; the east half lies on page 1."""
    side = np.linspace(-10, 10, cells + 1)
    x, y = np.meshgrid(side, side, indexing="ij")
    vertices = np.stack([x, y, height(x, y)], axis=2).reshape(-1, 3).astype(np.float32)
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    a = (i * (cells + 1) + j).ravel()
    b, c, d = a + cells + 1, a + cells + 2, a + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    page = (vertices[faces][:, :, 0].mean(axis=1) > 0).astype(np.int16)
    uv = np.stack([vertices[faces][..., 0] / 10 + np.where(page == 0, 1, 0)[:, None],
                   vertices[faces][..., 1] / 20 + 0.5], axis=2)  # fmt: skip
    return Mesh(frame, vertices, faces, uv=uv.astype(np.float32), page=page)


def house(frame: Frame = UTM) -> Mesh:
    """A box without a floor: walls on page 0 (v goes up), roof on page 1."""
    x0, y0 = HOUSE
    corners = [(x0, y0), (x0 + 3, y0), (x0 + 3, y0 + 2), (x0, y0 + 2)]
    vertices = np.array([(x, y, z) for z in (-0.5, 4.5) for x, y in corners], np.float32)
    faces, uv, page = [], [], []
    for k in range(4):
        m = (k + 1) % 4
        faces += [(k, m, m + 4), (k, m + 4, k + 4)]
        left, right = k / 4, (k + 1) / 4
        uv += [[(left, 0), (right, 0), (right, 1)], [(left, 0), (right, 1), (left, 1)]]
        page += [0, 0]
    faces += [(4, 5, 6), (4, 6, 7)]
    uv += [[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]]
    page += [1, 1]
    return Mesh(frame, vertices, np.array(faces, np.int32), uv=np.array(uv, np.float32), page=np.array(page, np.int16))


def picture(size: int = 256) -> np.ndarray:
    """(size, size, 3) RGB: red top left, green top right, blue bottom left, white bottom right."""
    image = np.empty((size, size, 3), np.uint8)
    half = size // 2
    image[:half, :half], image[:half, half:] = (220, 40, 40), (40, 200, 40)
    image[half:, :half], image[half:, half:] = (40, 40, 220), (240, 240, 240)
    return image


def textured(folder: Path, mesh: Mesh) -> Path:
    """Write a textured mesh as the `texture` step does."""
    folder.mkdir(parents=True)
    mesh.save(folder / "mesh.npz")
    pages = 0 if mesh.page is None or not len(mesh) else int(mesh.page.max()) + 1
    for page in range(pages):
        cv2.imwrite(str(folder / f"page_{page}.png"), picture()[:, :, ::-1])
        cv2.imwrite(str(folder / f"page_{page}_seen.png"), np.full((256, 256), 255, np.uint8))
    return folder


def world(folder: Path, frame: Frame = UTM, name: str = "street", things: Mesh | None = None, **params: Any) -> Done:
    """The made-up tile, collision made (with street furniture, if any) and exported below `folder`."""
    meshes = {"terrain": ground(frame=frame), "building": house(frame)}
    inputs = {group: textured(folder / group, mesh) for group, mesh in meshes.items()}
    solid = folder / "collision"
    solid.mkdir()
    sources = {group: path / "mesh.npz" for group, path in inputs.items()}
    if things is not None:
        sources["building"] = folder / "furnished.npz"
        with_furniture(replace(house(frame), uv=None, page=None), things).save(sources["building"])
    made = COLLISION.run(sources, CollisionParams(triangles=1000), solid, silent)
    out = folder / "export"
    out.mkdir()
    return EXPORT.run(
        {**inputs, "collision": made.files["mesh"]}, step_params(ExportParams, name=name, **params), out, silent
    )


def by_page(mesh: Mesh) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Page to the corners (F, 3, 3) and texture coordinates (F, 3, 2) of its faces, in order."""
    assert mesh.uv is not None and mesh.page is not None
    return {int(p): (mesh.corners[mesh.page == p], mesh.uv[mesh.page == p]) for p in np.unique(mesh.page)}


def collided(frame: Frame = UTM) -> Mesh:
    """What bodies collide with: ground, the house, and a pole of 10 cm at (-5, -5)."""
    ends = [(-5.0, -5.0, z) for z in (0.0, 4.0)]
    vertices, faces = tube(ends, (0.1, 0.1), 16)
    pole = Mesh(frame, vertices.astype(np.float32), faces)
    parts = {CODE["terrain"]: ground(10, frame), CODE["building"]: house(frame), CODE["pole"]: pole}
    first = np.cumsum([0, *(len(part.vertices) for part in parts.values())])
    return Mesh(
        frame,
        np.concatenate([part.vertices for part in parts.values()]),
        np.concatenate([part.faces + n for part, n in zip(parts.values(), first, strict=False)]).astype(np.int32),
        classification=np.repeat(np.array([*parts], np.uint8), [len(part) for part in parts.values()]),
    )


def view() -> View:
    """A photo from the south west, at eye height, that sees the house and the ground before it."""
    return View("front", pinhole(640, 480), look_at((-8, -9, 2), (0, 0, 1)), Path("front.jpg"), time=211_846_418.0)


def scene(folder: Path, frame: Frame = UTM, tiles: int = 2, apart: float = 25.0) -> Scene:
    """Tiles in a row, `apart` in metres, around the first one's origin: ground, a house with a sign as its roof."""
    world, names = folder / "world", []
    for i in range(tiles):
        x, y, z = frame.origin
        here = replace(frame, origin=(x + apart * i, y + 3.0 * i, z - i))
        roof = np.where(house().page == 1, CODE["road_sign"], 0).astype(np.uint8)
        meshes = {"terrain": ground(10, here), "building": replace(house(here), classification=roof)}
        sources = {group: textured(folder / f"tile{i}" / group, mesh) for group, mesh in meshes.items()}
        for group, level in REFLECTANCE.items():
            save_reflectance(sources[group], np.full(len(meshes[group].vertices), level, np.float32))
        solid = folder / f"tile{i}" / "collision.npz"
        collided(here).save(solid)
        lists = folder / f"tile{i}" / "plants.geojson"
        geojson.write_points(lists, frame.crs, [(here.to_crs((-5.0, -5.0, 0.0)).tolist(), {"height_m": 4.0})])
        photos = {group: np.zeros(len(mesh), np.int32) for group, mesh in meshes.items()}
        save_tile(world, f"tile{i}", sources, solid, {"plants.geojson": lists}, 0.8, views=[view()], photos=photos)
        names.append(f"tile{i}")
    write_scene_file(world, "town", frame, names)
    return read_scene(world)


def driven(out: Path) -> Scene:
    """One tile of it, and a way past the house's south on which it was driven through."""
    made = scene(out, tiles=1)
    x = np.linspace(-6.0, 8.0, 33)
    places = np.column_stack([x, np.full(33, -2.0), height(x, np.full(33, -2.0)) + 2])
    Trajectory(np.arange(33.0), places).save(made.tiles[0].folder / PATH_FILE)
    return made
