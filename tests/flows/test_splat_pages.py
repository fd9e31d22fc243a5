"""Splats in `scan2sim view`: the page and the film show what the project's own camera shows."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import scan2sim
from scan2sim.flows.reports.film import film, flight
from scan2sim.flows.reports.view import Pages
from scan2sim.pipeline.camera.renderer import pinhole
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, U8, Camera
from scan2sim.pipeline.io.worlds.scene import Scene
from scan2sim.texturing.evaluate import psnr
from tests.fakes import splat_scenes, synthetic
from tests.fakes.browser import Page, chromium

ALL_LOADED = (
    "window.world && world.loaded.size >= world.about.tiles.length"
    " && world.about.tiles.every(({name, splats}) => !splats || world.splats.shows(name))"
)
NEXT_FRAME_DRAWN = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"
COUNT_SCRIPTS = (
    "world.fetch = (...given) => (world.scripts.push(given[1]), Object.getPrototypeOf(world).fetch.apply(world, given))"
)
LOADING_ENDED = "new Promise(done => setTimeout(() => done(true), 1000))"  # more than three turns of the loop
AGREEMENT_DB = 35
WINDOW = (800, 500)
"""Size of the window in pixels: software draws it."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium(tmp_path_factory.mktemp("browser")) as page:
        yield page


@pytest.fixture
def page(browser: Page) -> Iterator[Page]:
    """The page of the module's browser, blank before and after each test."""
    browser.errors.clear()
    yield browser
    browser.do("Page.navigate", url="about:blank")


def open_page(page: Page, scene: Scene, folder: Path, *, phone: bool = False) -> None:
    """Open the page of a world from a file, and wait until everything is loaded."""
    pages = Pages(scene, folder, 1.0)
    for script in pages.scripts:
        pages.write(script)
    page.open(folder / "index.html", phone=phone, size=WINDOW)
    page.until(ALL_LOADED)


def look(page: Page, eye: tuple[float, float, float], target: tuple[float, float, float]) -> None:
    page.value(f"world.camera.position.set(...{[*eye]}), world.camera.lookAt(...{[*target]}), world.face()")


def drawn(page: Page) -> U8:
    """(H, W, 3) pixels of the canvas when all splats are sorted."""
    page.value("world.draw()")
    page.until("world.splats.settled")
    data = page.value("world.draw(), world.canvas.toDataURL('image/png')")
    image = Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2])))
    return np.asarray(image.convert("RGB"))


def camera_of(page: Page) -> tuple[F64, Camera]:
    """Pose (4, 4) and intrinsics of the page's camera."""
    width, height, matrix, projection = page.value(
        "[world.canvas.width, world.canvas.height, world.camera.matrixWorld.elements, "
        "world.camera.projectionMatrix.elements]"
    )
    pose = np.array(matrix).reshape(4, 4).T @ np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y up, z backwards
    fx, fy = projection[0] * width / 2, projection[5] * height / 2
    return pose, Camera("pinhole", width, height, fx, fy, (width - 1) / 2, (height - 1) / 2)


def agreement_db(a: U8, b: U8) -> float:
    return psnr(float(((a.astype(float) - b) ** 2).mean()))


def test_the_page_draws_splats_as_the_camera_in_python(page: Page, tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path)
    for seed, tile in enumerate(scene.tiles, start=1):
        splat_scenes.add(tile, seed)
    open_page(page, scene, tmp_path / "page")
    page.click("[data-photo='1']")
    for eye, target in (((-8, -9, 2), (0, 0, 1)), ((14, -9, 4), (25, 3, 2)), ((3, 3, 1.5), (-20, -7, 3))):
        look(page, eye, target)
        shown = drawn(page)
        pose, camera = camera_of(page)
        world = scan2sim.camera(tmp_path / "world")
        assert agreement_db(shown, world.render(pose, camera, samples=1).rgb) > AGREEMENT_DB
    page.click("[data-colour=photo]")
    surfaces = drawn(page)
    assert agreement_db(surfaces, shown) < 20
    page.click("[data-colour=splats]")
    assert np.array_equal(drawn(page), shown)
    page.click("[data-toggle=collision]")
    page.until("world.loaded.size === 4")
    assert not np.array_equal(drawn(page), shown), "collision geometry is drawn over splats"
    assert page.errors == []


def test_a_phone_shows_splats(page: Page, tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    splat_scenes.add(scene.tiles[0], count=500)
    open_page(page, scene, tmp_path / "page", phone=True)
    shown = drawn(page)
    pose, camera = camera_of(page)
    expected = scan2sim.camera(tmp_path / "world").render(pose, camera, samples=1).rgb
    assert agreement_db(shown, expected) > AGREEMENT_DB and page.errors == []


def test_splats_return_after_the_browser_took_the_graphics_memory(page: Page, tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    splat_scenes.add(scene.tiles[0], count=500)
    open_page(page, scene, tmp_path / "page")
    shown = drawn(page)
    page.value("void (window.lost = world.renderer.getContext().getExtension('WEBGL_lose_context')).loseContext()")
    page.until("world.renderer.getContext().isContextLost()")
    page.value(NEXT_FRAME_DRAWN)
    page.value("lost.restoreContext()")
    page.until(f"!world.renderer.getContext().isContextLost() && {ALL_LOADED}")
    assert agreement_db(drawn(page), shown) > AGREEMENT_DB and page.errors == []


def test_tiles_beyond_the_limits_are_dropped_once_and_return(page: Page, tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path)
    for seed, tile in enumerate(scene.tiles, start=1):
        splat_scenes.add(tile, seed, count=2500)
    open_page(page, scene, tmp_path / "page")
    page.click("[data-photo='1']")
    look(page, (5, -6, 3), (25, 3, 0))
    both = drawn(page)
    near, far = page.value("world.nearest().map(({name}) => name)")
    shows = f"world.splats.shows('{near}') && !world.splats.has('{far}')"

    page.value("world.splats.rows = 3")
    page.until(shows)
    assert agreement_db(drawn(page), both) < AGREEMENT_DB
    look(page, (30, -6, 3), (5, 0, 0))
    page.until(f"world.splats.shows('{far}') && !world.splats.has('{near}')")
    look(page, (5, -6, 3), (25, 3, 0))
    page.until(shows)
    page.value("world.splats.rows = 6")
    page.until(ALL_LOADED)
    assert agreement_db(drawn(page), both) > AGREEMENT_DB, "each tile has its own rows of the texture"

    page.value(f"void (world.scripts = [], {COUNT_SCRIPTS}, world.texels.set('{far}', 1e9))")
    page.until(f"!world.loaded.has('{far}')")
    page.value(LOADING_ENDED)
    assert page.value("world.scripts") == [] and page.value("document.head.querySelectorAll('script').length") == 0
    page.value(f"world.texels.delete('{far}')")
    page.until(ALL_LOADED)
    assert page.value("world.scripts") == [far, f"{far}_splats"]
    assert agreement_db(drawn(page), both) > AGREEMENT_DB and page.errors == []


def test_a_background_that_cannot_be_decoded_is_grey(page: Page, tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    splat_scenes.add(scene.tiles[0], count=500)
    open_page(page, scene, tmp_path / "page")
    page.click("[data-photo='1']")
    look(page, (-30, -30, 2), (-60, -60, 30))
    assert drawn(page).std() > 5
    page.value("void (window.createImageBitmap = () => Promise.reject(new Error('no decoder')))")
    page.value("world.splats.restore()")
    page.until(ALL_LOADED)
    assert (drawn(page) == 128).all() and page.errors == []


def test_a_tile_without_splats_shows_its_surfaces(page: Page, tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path)
    splat_scenes.add(scene.tiles[0])
    open_page(page, scene, tmp_path / "page")
    page.click("[data-photo='1']")
    look(page, (5, -6, 3), (25, 3, 0))
    mixed = drawn(page).astype(int)
    pose, camera = camera_of(page)
    splats = scan2sim.camera(tmp_path / "world").render(pose, camera, samples=1).rgb
    page.click("[data-colour=photo]")
    surfaces = drawn(page)
    is_splat, is_surface = ((np.abs(mixed - other).max(axis=2) < 8) for other in (splats, surfaces))
    assert (is_splat | is_surface).mean() > 0.98
    assert (~is_splat).mean() > 0.05 and (~is_surface).mean() > 0.3


def test_a_world_without_splats_has_no_button_for_them(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path)
    pages = Pages(scene, tmp_path / "page", 1.0)
    assert 'data-colour="splats"' not in (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert not any("splats" in script for script in pages.scripts)


def test_the_film_shows_splats(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="PyAV isn't installed")
    scene = synthetic.scene(tmp_path, tiles=1)
    splat_scenes.add(scene.tiles[0], count=500)
    film(scene, tmp_path / "flight.mp4", 0.1, 160, silent)
    with av.open(str(tmp_path / "flight.mp4")) as video:
        first = next(frame.to_ndarray(format="rgb24") for frame in video.decode(video=0))
    expected = scan2sim.camera(tmp_path / "world").render(flight(scene, 2)[0], pinhole(160, 90)).rgb
    assert agreement_db(first, expected) > 24
