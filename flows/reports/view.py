"""Web viewer of a finished world: a folder that a browser opens with or without a server, loading tile by tile."""

from __future__ import annotations

import base64
import shutil
import sys
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from pydantic import Field

from scan2sim.flows.reports.tile import PAGES
from scan2sim.pipeline.core.classes import CODE_OF_SURFACE, colour_of, name_of
from scan2sim.pipeline.core.errors import SettingError, from_os_error
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import F64, View
from scan2sim.pipeline.io.file_checks import make_folder
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds import glb
from scan2sim.pipeline.io.worlds.glb import GlbParams
from scan2sim.pipeline.io.worlds.packed_splats import script_arguments
from scan2sim.pipeline.io.worlds.provenance import SOURCES
from scan2sim.pipeline.io.worlds.scene import Scene, SceneTile
from scan2sim.pipeline.io.worlds.spawn import courses
from scan2sim.pipeline.steps.pictures import DRIVER_EYE_HEIGHT_M, SEEN_RGB, bird_pose

TEMPLATE, INDEX, TILES = "view.html.j2", "index.html", "tiles"
COLLISION, SPLATS = "_collision", "_splats"
"""After a tile's name: the scripts of its collision mesh and its splats."""
SCRIPTS = ("three.js", "walk.js", "splats.js", "view.js")
CALL = "scan2simTile"
"""JavaScript function of the page that the scripts of each tile call."""
SOURCE_RGB = {name: SEEN_RGB[level] for name, level in zip(SOURCES, (64, 128, 255), strict=True)}
LOOPBACK_HOSTS = ("localhost", "127.0.0.1", "[::1]")
"""Accepted Host headers; others are rejected, as protection against DNS rebinding."""


class ViewParams(Params):
    """Parameters of the web viewer and of the flight.

    Attributes:
        megapixels: maximum size of all textures of a tile; larger ones are scaled down.
        port: TCP port of the server; 0: any free one.
        seconds: duration of the flight.
        width: image width of the flight in pixels.
    """

    megapixels: float = Field(
        16.0,
        ge=0.1,
        le=1000,
        description="Maximum texture size of each tile in megapixels; larger textures are scaled down.",
    )
    port: int = Field(0, ge=0, le=65535, description="Port of the page on this machine; 0: any free port.")
    seconds: float = Field(10.0, ge=0.1, le=3600, description="Duration of the flight (--film) in seconds.")
    width: int = Field(
        960, ge=64, le=7680, description="Image width of the flight (--film) in pixels; the aspect ratio is 16:9."
    )


class Pages:
    """The folder of a world's web page.

    Args:
        scene: the world.
        folder: folder of the page; created.
        megapixels: maximum size of all textures of a tile.
    """

    def __init__(self, scene: Scene, folder: Path, megapixels: float) -> None:
        self.folder = folder
        self._tiles = {tile.name: tile for tile in scene.with_dome}
        self._megapixels = megapixels
        self._writing = threading.Lock()
        make_folder(folder / TILES)
        for script in SCRIPTS:
            shutil.copyfile(PAGES / script, folder / script)
        (folder / INDEX).write_text(_page(scene), encoding="utf-8")

    @property
    def scripts(self) -> list[str]:
        """Names of the script files of all tiles and the dome, which `write` creates."""
        return [
            f"{name}{kind}.js"
            for name, tile in self._tiles.items()
            for kind, exists in (("", True), (COLLISION, tile.groups), (SPLATS, tile.splat_count))
            if exists
        ]

    def write(self, script: str) -> None:
        """Create the script of a tile unless it exists; ignores unknown names."""
        if script not in self.scripts:
            return
        with self._writing:
            path = self.folder / TILES / script
            if path.is_file():
                return
            fresh = path.with_suffix(".part")
            fresh.write_text(f'{CALL}("{path.stem}", {self._arguments(path.stem)});\n', encoding="ascii")
            fresh.replace(path)

    def _arguments(self, name: str) -> str:
        """What a script passes to the page, in base64: a GLB, or splats and their background."""
        if name not in self._tiles and name.endswith(SPLATS):
            layer = self._tiles[name.removesuffix(SPLATS)].splats()
            assert layer is not None
            return script_arguments(layer)
        packed = self.folder / TILES / f"{name}.glb"
        if name in self._tiles:
            _write_shown(packed, self._tiles[name], self._megapixels)
        else:
            glb.write_solid(packed, self._tiles[name.removesuffix(COLLISION)].solid())
        text = base64.b64encode(packed.read_bytes()).decode()
        packed.unlink()
        return f'"{text}"'


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print the traceback of an error, unless the browser has closed the connection: when its page is left."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def server(pages: Pages, port: int) -> ThreadingHTTPServer:
    """HTTP server of a page, for this machine only; creates tiles on request. Start it by `serve_forever`.

    Raises:
        SettingError: the port is in use.
    """

    class Handler(SimpleHTTPRequestHandler):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given, directory=str(pages.folder))

        def do_GET(self) -> None:
            host = self.headers.get("Host", "").rsplit(":", 1)[0]
            if host not in LOOPBACK_HOSTS:
                self.send_error(403, "Use the host name localhost")
                return
            _, _, script = urlsplit(self.path).path.partition(f"/{TILES}/")
            try:
                pages.write(script)
            except OSError as error:
                print(f"error: {from_os_error(error, pages.folder)}", file=sys.stderr)
                self.send_error(507, "The page can't be written")
                return
            super().do_GET()

        def end_headers(self) -> None:
            self.send_header("Cache-Control", "no-cache")
            super().end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    try:
        return _Server(("127.0.0.1", port), Handler)
    except OSError as error:
        raise SettingError(
            "--port", f"can't listen on port {port} ({error})", "Choose another port, or 0 for any free one"
        ) from None


def _write_shown(path: Path, tile: SceneTile, megapixels: float) -> None:
    """Write the visible meshes of a tile as GLB, with its textures scaled down to `megapixels`."""
    surfaces = [*tile.surfaces(), *tile.backdrop()]
    pages = {surface.shape.pages[page] for surface in surfaces for page in surface.shape.used_pages}
    texels = sum(int(np.prod(image.size_of(page))) for page in pages)
    scale = min(1.0, (megapixels * 1e6 / texels) ** 0.5)
    glb.write(path, surfaces, GlbParams(jpeg_quality=85), views=tile.views(), scale=scale)


def _page(scene: Scene) -> str:
    from jinja2 import Environment, PackageLoader

    env = Environment(loader=PackageLoader("scan2sim.flows.reports", "."), autoescape=True)
    about = _about(scene)
    return env.get_template(TEMPLATE).render(name=scene.name, about=about, sources=SOURCE_RGB)


def _about(scene: Scene) -> dict[str, Any]:
    """Data of the page: tiles and photo poses, in world metres."""
    low = np.min([np.add(tile.low, tile.offset) for tile in scene.tiles], axis=0)
    high = np.max([np.add(tile.high, tile.offset) for tile in scene.tiles], axis=0)
    air = bird_pose(low, high)
    photos = _photos(scene)
    walk = _ahead(np.array(photos[len(photos) // 2]["pose"]).reshape(4, 4)) if photos else _on_ground(scene, low, high)
    codes = colour_of()
    return {
        "tiles": [
            {"name": tile.name, "offset": tile.offset, "low": tile.low, "high": tile.high, "splats": tile.splat_count,
             "triangles": sum(group["triangles"] for group in tile.groups.values())}
            for tile in scene.tiles
        ],
        "splats": scene.has_splats,
        "dome": scene.dome and {"name": scene.dome.name, "offset": scene.dome.offset, "far": scene.far},
        "photos": photos,
        "colours": {name_of(code): codes[code].tolist() for code in sorted(set(CODE_OF_SURFACE.values()) | {64, 65})},
        "sources": list(SOURCE_RGB.values()),
        "sky": scene.sky,
        "start": "walk" if photos else "turn",
        "walk": walk,
        "turn": _ahead(air, (low[2] - air[2, 3]) / air[2, 2]),
    }  # fmt: skip


def _photos(scene: Scene) -> list[dict[str, Any]]:
    """Name, pose and field of view of each photo, sorted by time and name."""
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


def _ahead(pose: F64, distance: float = 20.0) -> list[list[float]]:
    """Position of a camera, and the point at `distance` metres in its viewing direction."""
    eye = pose[:3, 3]
    return [eye.round(3).tolist(), (eye + distance * pose[:3, 2]).round(3).tolist()]


def _on_ground(scene: Scene, low: F64, high: F64) -> list[list[float]]:
    """Start position and target on the road, else along the longer side; the page moves it to the ground."""
    for way in courses(scene):
        positions = way.places + (0, 0, 0 if way.by == "path" else DRIVER_EYE_HEIGHT_M)
        return [positions[len(positions) // 4].round(3).tolist(), positions[-1].round(3).tolist()]
    middle, along = (low + high) / 2, np.eye(3)[int(np.argmax((high - low)[:2]))]
    start = middle - along * (high - low) * 0.4
    start[2] = middle[2] = low[2] + DRIVER_EYE_HEIGHT_M
    return [start.round(3).tolist(), middle.round(3).tolist()]
