"""A finished world as a page: a folder that a browser shows without a server, tile by tile, or with one."""

from __future__ import annotations

import base64
import shutil
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from pydantic import Field

from scan2sim.flows.reports.tile import PAGES
from scan2sim.pipeline.core.classes import CODE_OF_SURFACE, colour_of, name_of
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import F64, View
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds import glb
from scan2sim.pipeline.io.worlds.glb import GlbParams
from scan2sim.pipeline.io.worlds.provenance import SOURCES
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile
from scan2sim.pipeline.simulation.spawn import courses
from scan2sim.pipeline.steps.pictures import EYE_HEIGHT, SEEN_RGB, bird_pose

TEMPLATE, INDEX, TILES, COLLISION = "view.html.j2", "index.html", "tiles", "_collision"
SCRIPTS = ("three.js", "walk.js", "view.js")
CALL = "scan2simTile"
"""The page's function that each tile's script calls."""
SOURCE_RGB = {name: SEEN_RGB[level] for name, level in zip(SOURCES, (64, 128, 255), strict=True)}
OWN_NAMES = ("localhost", "127.0.0.1", "[::1]")
"""Of this machine for itself: a page of another name that leads here isn't answered."""


class ViewParams(Params):
    """What a browser is given.

    Attributes:
        megapixels: of a tile's texture pages together; larger ones are scaled down.
        port: to be served on; 0: any that is free.
        seconds: that a flight takes.
        width: of its picture, pixels.
    """

    megapixels: float = Field(16.0, ge=0.1, le=1000, description="Of a tile's textures, which are scaled down to that.")
    port: int = Field(0, ge=0, le=65535, description="Port on this machine; 0 for any that is free.")
    seconds: float = Field(10.0, ge=0.1, le=3600, description="That the flight takes.")
    width: int = Field(960, ge=64, le=7680, description="Of the flight's picture, pixels; it is 16 to 9.")


class Pages:
    """The folder of a world's page.

    Args:
        scene: the world.
        folder: for the page; made.
        megapixels: of a tile's texture pages together.
    """

    def __init__(self, scene: Scene, folder: Path, megapixels: float) -> None:
        self.folder = folder
        self._tiles = {tile.name: tile for tile in scene.tiles}
        self._megapixels = megapixels
        self._writing = threading.Lock()
        make_folder(folder / TILES)
        for script in SCRIPTS:
            shutil.copyfile(PAGES / script, folder / script)
        (folder / INDEX).write_text(_page(scene), encoding="utf-8")

    @property
    def scripts(self) -> list[str]:
        """Of all tiles: names of files that `write` makes."""
        return [f"{name}{kind}.js" for name in self._tiles for kind in ("", COLLISION)]

    def write(self, script: str) -> None:
        """Make a tile's script, unless it is there; names of others are nothing's."""
        if script not in self.scripts:
            return
        with self._writing:
            path = self.folder / TILES / script
            if path.is_file():
                return
            packed = path.with_suffix(".glb")
            stem = path.stem
            if stem in self._tiles:
                _write_shown(packed, self._tiles[stem], self._megapixels)
            else:
                glb.write_solid(packed, self._tiles[stem.removesuffix(COLLISION)].solid())
            text = base64.b64encode(packed.read_bytes()).decode()
            fresh = path.with_suffix(".part")
            fresh.write_text(f'{CALL}("{stem}", "{text}");\n', encoding="ascii")
            fresh.replace(path)
            packed.unlink()


def server(pages: Pages, port: int) -> ThreadingHTTPServer:
    """What serves a page on this machine alone, tiles made as they are asked for; begin with `serve_forever`.

    Raises:
        SettingError: the port is taken.
    """

    class Handler(SimpleHTTPRequestHandler):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given, directory=str(pages.folder))

        def do_GET(self) -> None:
            host = self.headers.get("Host", "").rsplit(":", 1)[0]
            if host not in OWN_NAMES:
                self.send_error(403, "Ask for localhost")
                return
            _, _, script = urlsplit(self.path).path.partition(f"/{TILES}/")
            pages.write(script)
            super().do_GET()

        def end_headers(self) -> None:
            self.send_header("Cache-Control", "no-cache")
            super().end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    try:
        return ThreadingHTTPServer(("127.0.0.1", port), Handler)
    except OSError as error:
        raise SettingError("--port", f"can't listen on port {port} ({error})", "Choose another, or 0") from None


def _write_shown(path: Path, tile: SceneTile, megapixels: float) -> None:
    """A tile as it is seen, its pages scaled to so many megapixels."""
    pages = [shape.pages[page] for shape in tile.textured().values() for page in shape.used_pages]
    texels = sum(int(np.prod(image.size_of(page))) for page in pages)
    scale = min(1.0, (megapixels * 1e6 / texels) ** 0.5)
    glb.write(path, tile.surfaces(), GlbParams(jpeg_quality=85), views=tile.views(), scale=scale)


def _page(scene: Scene) -> str:
    from jinja2 import Environment, PackageLoader

    env = Environment(loader=PackageLoader("scan2sim.flows.reports", "."), autoescape=True)
    about = _about(scene)
    return env.get_template(TEMPLATE).render(name=scene.name, about=about, sources=SOURCE_RGB)


def _about(scene: Scene) -> dict[str, Any]:
    """What the page is told: tiles and photos' poses, metres in the world."""
    low = np.min([np.add(tile.low, tile.offset) for tile in scene.tiles], axis=0)
    high = np.max([np.add(tile.high, tile.offset) for tile in scene.tiles], axis=0)
    air = bird_pose(low, high)
    photos = _photos(scene)
    walk = _ahead(np.array(photos[len(photos) // 2]["pose"]).reshape(4, 4)) if photos else _on_ground(scene, low, high)
    codes = colour_of()
    return {
        "tiles": [
            {"name": tile.name, "offset": tile.offset, "low": tile.low, "high": tile.high,
             "triangles": sum(group["triangles"] for group in tile.groups.values())}
            for tile in scene.tiles
        ],
        "photos": photos,
        "colours": {name_of(code): codes[code].tolist() for code in sorted(set(CODE_OF_SURFACE.values()) | {64, 65})},
        "sources": list(SOURCE_RGB.values()),
        "start": "walk" if photos else "turn",
        "walk": walk,
        "turn": _ahead(air, (low[2] - air[2, 3]) / air[2, 2]),
    }  # fmt: skip


def _photos(scene: Scene) -> list[dict[str, Any]]:
    """Where photos were taken, each once, in the order of their times and names."""
    found: dict[str, tuple[float, dict[str, Any]]] = {}
    for tile in scene.tiles:
        for view in tile.views():
            if view.camera.model != "orthographic":
                found.setdefault(view.name, (view.time or 0.0, _photo(view, tile)))
    return [photo for _, photo in sorted(found.values(), key=lambda one: (one[0], one[1]["name"]))]


def _photo(view: View, tile: SceneTile) -> dict[str, Any]:
    pose = np.array(view.T_world_cam, np.float64)
    pose[:3, 3] += tile.offset
    camera = view.camera
    field = 90.0 if camera.model == "equirectangular" else 2 * np.degrees(np.arctan(camera.height / 2 / camera.fy))
    return {
        "name": view.name, "pose": pose.round(5).ravel().tolist(), "field": round(float(field), 2),
        "aspect": round(camera.width / camera.height, 4),
    }  # fmt: skip


def _ahead(pose: F64, reach: float = 20.0) -> list[list[float]]:
    """Where a camera is, and what lies so many metres ahead of it."""
    eye = pose[:3, 3]
    return [eye.round(3).tolist(), (eye + reach * pose[:3, 2]).round(3).tolist()]


def _on_ground(scene: Scene, low: F64, high: F64) -> list[list[float]]:
    """An eye on the road that looks along it, else along the world; the page puts it onto the ground."""
    for way in courses(scene):
        places = way.places + (0, 0, 0 if way.by == "path" else EYE_HEIGHT)
        return [places[len(places) // 4].round(3).tolist(), places[-1].round(3).tolist()]
    middle, along = (low + high) / 2, np.eye(3)[int(np.argmax((high - low)[:2]))]
    start = middle - along * (high - low) * 0.4
    start[2] = middle[2] = low[2] + EYE_HEIGHT
    return [start.round(3).tolist(), middle.round(3).tolist()]
