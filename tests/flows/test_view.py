"""`scan2sim view`: the web viewer in a browser, its server, and the flight video."""

from __future__ import annotations

import errno
import threading
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.flows.reports.comparison_film import comparison_film
from scan2sim.flows.reports.film import film, flight
from scan2sim.flows.reports.view import Pages, server
from scan2sim.pipeline.camera.renderer import Image, Renderer
from scan2sim.pipeline.core.errors import DataError, SettingError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds.scene import TRACKS_FILE, read_scene
from scan2sim.pipeline.tracking.tracks import write_tracks
from tests.fakes import synthetic, traffic
from tests.fakes.browser import Page, chromium

ALL_TILES_LOADED = (
    "world.loaded.size >= world.about.tiles.length && !document.querySelector('[role=status]').textContent"
)
NEXT_FRAME_DRAWN = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"


def run(*words: object) -> None:
    done = CliRunner().invoke(app, ["view", *map(str, words)])
    if done.exception is not None:
        raise done.exception


def canvas_pixels(page: Page) -> np.ndarray:
    """Pixels of the canvas below the buttons."""
    page.value(NEXT_FRAME_DRAWN)
    return page.screenshot()[80:700, :900].astype(int)


def test_viewer_shows_all_tiles_in_all_colour_modes(tmp_path: Path) -> None:
    synthetic.scene(tmp_path)
    run(tmp_path / "world", "--out", tmp_path / "page")
    with chromium(tmp_path) as page:
        page.open(tmp_path / "page" / "index.html")  # from a file, without a server
        page.until(f"window.world && {ALL_TILES_LOADED}")
        page.click("[data-photo='1']")
        eye = np.array(page.value("document.querySelector('output').value").split(), float)
        np.testing.assert_allclose(eye, [-8, -9, 2], atol=0.01)
        photo = canvas_pixels(page)
        assert photo.std() > 30
        pictures = [photo]
        for kind in ("class", "source", "distance"):
            page.click(f"[data-colour={kind}]")
            pictures.append(canvas_pixels(page))
            assert page.value("document.getElementById('legend').innerText").strip()
        assert all(np.abs(a - b).mean() > 3 for i, a in enumerate(pictures) for b in pictures[:i])
        page.click("[data-colour=photo]")
        assert (canvas_pixels(page) == photo).all()
        page.click("[data-toggle=wireframe]")
        assert np.abs(canvas_pixels(page) - photo).mean() > 0.5
        page.click("[data-toggle=wireframe]")
        page.click("[data-toggle=collision]")
        page.until(f"world.loaded.size === 4 && {ALL_TILES_LOADED}")
        assert np.abs(canvas_pixels(page) - photo).mean() > 3
        page.click("[data-to=turn]")
        assert np.abs(canvas_pixels(page) - photo).mean() > 10
        page.open(tmp_path / "page" / "index.html", phone=True)
        page.until(f"window.world && {ALL_TILES_LOADED}")
        assert page.errors == []


def test_viewer_walks_through_a_world_without_photos(tmp_path: Path) -> None:
    synthetic.world(tmp_path)
    run(tmp_path / "export" / "world", "--out", tmp_path / "page")
    with chromium(tmp_path) as page:
        page.open(tmp_path / "page" / "index.html")
        page.until(f"window.world && {ALL_TILES_LOADED}")
        above = canvas_pixels(page)
        page.click("[data-to=walk]")
        assert np.abs(canvas_pixels(page) - above).mean() > 10 and page.errors == []
        x, y, z = map(float, page.value("document.querySelector('output').value").split())
        assert z == pytest.approx(float(synthetic.height(np.array(x), np.array(y))) + 1.6, abs=0.1)
        assert page.value("document.getElementById('photos').hidden")


def test_ceilings_are_seen_from_inside_only(tmp_path: Path) -> None:
    synthetic.world(tmp_path)
    run(tmp_path / "export" / "world", "--out", tmp_path / "page")
    copy_of_the_ground = """(() => {
        const ceiling = [...world.tiles.values()][0].find((mesh) => mesh.name.startsWith("terrain")).clone();
        ceiling.name = "ceiling";
        ceiling.position.z += 3;
        world.put("ceiling", [ceiling], false);
        return true;
    })()"""
    with chromium(tmp_path) as page:
        page.open(tmp_path / "page" / "index.html")
        page.until(f"window.world && {ALL_TILES_LOADED}")
        above = canvas_pixels(page)
        page.click("[data-to=walk]")
        inside = canvas_pixels(page)
        page.value(copy_of_the_ground)
        assert np.abs(canvas_pixels(page) - inside).mean() > 3
        page.click("[data-to=turn]")
        assert (canvas_pixels(page) == above).all() and page.errors == []


def test_missing_tile_script_is_reported(tmp_path: Path) -> None:
    synthetic.scene(tmp_path)
    run(tmp_path / "world", "--out", tmp_path / "page")
    (tmp_path / "page" / "tiles" / "tile1.js").unlink()
    with chromium(tmp_path) as page:
        page.open(tmp_path / "page" / "index.html")
        page.until("document.querySelector('[role=status]').textContent.includes(\"tile1.js isn't beside\")")


def test_server_creates_tiles_on_request_and_rejects_other_hosts(tmp_path: Path) -> None:
    pages = Pages(synthetic.scene(tmp_path), tmp_path / "page", 1.0)
    with server(pages, 0) as served:
        threading.Thread(target=served.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{served.server_port}"
        try:
            assert b"<title>town" in urllib.request.urlopen(f"{address}/").read()
            assert not any((tmp_path / "page" / "tiles").iterdir())
            for script in ("tile0.js", "tile0_collision.js"):
                body = urllib.request.urlopen(f"{address}/tiles/{script}").read()
                assert body.startswith(f'scan2simTile("{script.removesuffix(".js")}", "'.encode())
            for name, host in (("/tiles/tile7.js", None), ("/../world/metadata.json", None), ("/", "elsewhere.org")):
                request = urllib.request.Request(address + name, headers={"Host": host} if host else {})
                with pytest.raises(urllib.error.HTTPError) as caught:
                    urllib.request.urlopen(request)
                assert caught.value.code == (403 if host else 404)
            with pytest.raises(SettingError, match="can't listen"):
                server(pages, served.server_port)
        finally:
            served.shutdown()


def test_a_full_disk_and_closed_connections_print_no_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pages = Pages(synthetic.scene(tmp_path), tmp_path / "page", 1.0)

    def refuse(script: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pages, "write", refuse)
    with server(pages, 0) as served:
        threading.Thread(target=served.serve_forever, daemon=True).start()
        try:
            with pytest.raises(urllib.error.HTTPError, match="507"):
                urllib.request.urlopen(f"http://127.0.0.1:{served.server_port}/tiles/tile0.js")
            try:
                raise BrokenPipeError
            except BrokenPipeError:
                served.handle_error(None, ("127.0.0.1", 1))  # type: ignore[arg-type]
        finally:
            served.shutdown()
    errors = capsys.readouterr().err
    assert "no space left on the disk" in errors and "Traceback" not in errors


def test_flight_is_a_video_of_the_world(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="PyAV isn't installed")
    synthetic.scene(tmp_path)
    run(tmp_path / "world", "--film", tmp_path / "flight.mp4", "--seconds", 0.25, "--width", 160)
    with av.open(str(tmp_path / "flight.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == 6 and frames[0].shape == (90, 160, 3)
    assert all(frame.std() > 15 for frame in frames)
    assert np.abs(frames[0].astype(int) - frames[3]).mean() > 5


def test_failing_flight_keeps_the_earlier_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("av", reason="PyAV isn't installed")
    scene = synthetic.scene(tmp_path)
    view = Renderer.view

    def failing(self: Renderer, camera: Camera, pose: F64, **how: Any) -> Image:
        if len(seen_from) > 50:  # the encoder has written data by then
            raise ZeroDivisionError("a bug")
        seen_from.append(pose)
        return view(self, camera, pose, **how)

    seen_from: list[F64] = []
    monkeypatch.setattr(Renderer, "view", failing)
    (tmp_path / "flight.mp4").write_text("an earlier one", encoding="utf-8")
    with pytest.raises(ZeroDivisionError):
        film(scene, tmp_path / "flight.mp4", 4, 64, silent)
    assert (tmp_path / "flight.mp4").read_text(encoding="utf-8") == "an earlier one"
    assert read_scene(tmp_path) == scene and sorted(path.suffix for path in tmp_path.glob("*flight*")) == [".mp4"]


def test_flight_without_road_circles_around_the_world(tmp_path: Path) -> None:
    poses = np.array(flight(synthetic.scene(tmp_path, tiles=1), 12))
    away = np.linalg.norm(poses[:, :2, 3], axis=1)
    assert np.ptp(away) < 1 and away.min() > 14 and (poses[:, 2, 3] > 5).all()
    assert (poses[:, :3, 2] * poses[:, :3, 3] < 1).all() and (poses[:, 2, 2] < 0).all()  # they look at the middle


def test_comparison_film_shows_the_traffic_beside_the_photos(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    tile = scene.tiles[0]
    van = traffic.drive(2, "van", (5.0, 2.0, 2.2), (-4.0, 4.0), -1.0, 0.0, 4.0)
    start = synthetic.view().time
    assert start is not None
    track = replace(van, times=van.times - van.times[0] + start, colour=(230, 30, 30))
    write_tracks(
        tile.folder / TRACKS_FILE, [replace(track, poses=track.poses - (0, 0, traffic.HEIGHT_M, 0))], tile.frame
    )
    photo = tmp_path / "front.png"
    image.write(photo, np.full((480, 640, 3), (20, 20, 200), np.uint8))
    file = tmp_path / "film.mp4"
    comparison_film(read_scene(tmp_path / "world"), {"front": photo}, file, 160, silent)
    import av

    with av.open(str(file)) as container:
        (frame,) = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    assert frame.shape == (240, 160, 3)
    recorded, shown = frame[:120], frame[120:]
    assert np.abs(recorded - (20, 20, 200)).max() < 20
    red = (shown[..., 0] > 120) & (shown[..., 1] < 80) & (shown[..., 2] < 80)
    assert 0.02 < red.mean() < 0.6
    with pytest.raises(DataError, match="--compare"):
        comparison_film(scene, {"other": photo}, tmp_path / "none.mp4", 160, silent)
    assert not (tmp_path / "none.mp4").exists()
