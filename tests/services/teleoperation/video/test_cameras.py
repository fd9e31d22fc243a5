from __future__ import annotations

import http.server
import itertools
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError, SettingError, UnavailableError
from scan2sim.pipeline.core.splats import SplatLayer, Splats
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io.worlds.scene import SPLATS_FILE, read_scene
from scan2sim.services.teleoperation import cameras, timecode
from scan2sim.services.teleoperation.cameras import Mount, View, pattern
from scan2sim.services.teleoperation.settings import VehicleParams
from scan2sim.texturing.world_camera import WorldCamera
from tests.fakes import synthetic
from tests.fakes.ports import free_port
from tests.fakes.virtual_clock import VirtualClock
from tests.services.teleoperation.video.videos import psnr, scenery
from tests.waiting import until

take = itertools.islice


def write(folder: Path, count: int) -> list[U8]:
    folder.mkdir()
    images = [frame.image for frame in take(scenery(160, 120), count)]
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / f"{i:03}.png"), image[..., ::-1])
    return images


def test_frames_arrive_at_their_rate_with_their_capture_time() -> None:
    began = time.monotonic_ns()
    times = [frame.captured for frame in take(cameras.frames("pattern", View(width=64, height=48, fps=50.0)), 20)]
    assert began <= times[0] and times == sorted(times) and times[-1] <= time.monotonic_ns()
    assert (times[-1] - times[0]) / 1e9 >= 0.34  # a late frame is followed by one at once


def test_frame_times_skip_missed_frames() -> None:
    clock = VirtualClock(0.0)
    times = cameras.frame_times(50.0, clock=clock.ns, sleep=clock.sleep)
    assert [round(one / 1e6) for one in take(times, 4)] == [0, 20, 40, 60]
    clock.sleep(0.015)  # the consumer is busy
    assert [round(one / 1e6) for one in take(times, 2)] == [80, 100]
    clock.sleep(1.0)  # it stalls: one frame of the missed ones follows
    assert [round(one / 1e6) for one in take(times, 4)] == [1100, 1100, 1120, 1140]


@pytest.mark.parametrize("source", ["pattern", "replay"])
def test_timecode_is_drawn_on_request(source: str, tmp_path: Path) -> None:
    write(tmp_path / "pictures", 3)
    view = View(str(tmp_path / "pictures"), 320, 240, draw_timecode=True)
    for frame in take(cameras.frames(source, view), 7):
        read = timecode.read(frame.image, frame.captured + 10**9, 320)
        assert read is not None and 0 <= frame.captured - read < timecode.TICK_NS


@pytest.mark.parametrize("cache_bytes", [10**9, 0], ids=["in memory", "decoded again"])
def test_folder_is_replayed_in_a_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cache_bytes: int) -> None:
    from scan2sim.services.teleoperation.cameras import replay

    monkeypatch.setattr(replay, "CACHE_MAX_BYTES", cache_bytes)
    images = write(tmp_path / "pictures", 3)
    view = View(str(tmp_path / "pictures"), 160, 120, fps=500.0)
    shown = [frame.image for frame in take(cameras.frames("replay", view), 7)]
    assert all(np.array_equal(image, images[i % 3]) for i, image in enumerate(shown))


def test_video_is_replayed_in_the_requested_size(tmp_path: Path) -> None:
    file = str(tmp_path / "drive.avi")
    writer = cv2.VideoWriter(file, cv2.VideoWriter.fourcc(*"MJPG"), 30, (160, 120))
    images = [frame.image for frame in take(scenery(160, 120), 4)]
    for image in images:
        writer.write(image[..., ::-1])
    writer.release()
    shown = [frame.image for frame in take(cameras.frames("replay", View(file, 80, 60, fps=500.0)), 9)]
    for i, image in enumerate(shown):
        assert psnr(image, cv2.resize(images[i % 4], (80, 60), interpolation=cv2.INTER_AREA).astype(np.uint8)) > 25


def test_unreadable_sources_are_reported(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for source, where in (("replay", "empty"), ("replay", "none.mp4"), ("device", "none.mp4"), ("world", "empty")):
        with pytest.raises(InputError) as caught:
            next(cameras.frames(source, View(str(tmp_path / where))))
        assert caught.value.where.startswith(str(tmp_path / where))
    with pytest.raises(SettingError, match="unknown value 'lidar'"):
        next(cameras.frames("lidar", View()))


class _Server:
    """A network camera that sends JPEGs over HTTP, and breaks its connection after some frames."""

    def __init__(self, sizes: Iterator[tuple[int, int]]) -> None:
        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                still = pattern.bars(*next(sizes))
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                for i in range(20):
                    jpeg = cv2.imencode(".jpg", pattern.draw_at(still, i / 30))[1].tobytes()
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                    self.wfile.write(head.encode() + jpeg + b"\r\n")
                    time.sleep(0.01)

            def log_message(self, *_: object) -> None:
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self.server.server_port}/"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


def test_network_camera_is_reopened_with_another_frame_size() -> None:
    server = _Server(itertools.cycle([(160, 120), (320, 240)]))
    began, seen = time.monotonic_ns(), set[tuple[int, ...]]()
    camera = cameras.Camera("rear", lambda: cameras.frames("device", View(server.address)))

    def both_seen() -> bool:
        if frame := camera.read(1.0):
            assert began <= frame.captured <= time.monotonic_ns()
            seen.add(frame.image.shape)
        return len(seen) == 2

    until(both_seen)
    camera.close()
    server.server.shutdown()
    server.server.server_close()
    assert seen == {(120, 160, 3), (240, 320, 3)}


@pytest.mark.parametrize("kind", ["device", "replay"])
@pytest.mark.parametrize("scheme", ["rtsp", "http"])
def test_unreachable_camera_is_reported_without_its_credentials(kind: str, scheme: str) -> None:
    """Neither the command's error nor the fault on the driver page contains them."""
    address = f"{scheme}://admin:hunter2@127.0.0.1:{free_port()}/live?token=s3cret"
    expected = address.replace("admin:hunter2", "***").replace("s3cret", "***")
    with pytest.raises(InputError) as caught:
        next(cameras.frames(kind, View(address)))
    camera = cameras.Camera("front", lambda: cameras.frames(kind, View(address)))
    until(lambda: camera.fault)
    camera.close()
    for text in (str(caught.value), repr(caught.value), camera.fault):
        assert expected in text and "hunter2" not in text and "s3cret" not in text


def test_camera_without_a_name_is_refused_without_its_credentials(tmp_path: Path) -> None:
    pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
    from scan2sim.services.teleoperation.vehicle import app

    camera = "rtsp://admin:hunter2@192.0.2.1/live"
    with pytest.raises(SettingError, match=r"--camera: rtsp://\*\*\*@192\.0\.2\.1/live is not NAME=VALUE"):
        app._cameras(VehicleParams(certificates=tmp_path, gateway="gate.example", camera=(camera,)))


def test_library_error_is_reported_without_the_credentials_of_the_camera() -> None:
    def broken() -> Iterator[cameras.CameraFrame]:
        raise OSError("no route to rtsp://admin:hunter2@192.0.2.1/live")

    camera = cameras.Camera("front", broken)
    until(lambda: camera.fault)
    camera.close()
    assert camera.fault == "no route to rtsp://***@192.0.2.1/live"


def test_simulated_camera_renders_the_world_from_its_vehicle(tmp_path: Path) -> None:
    folder = synthetic.world(tmp_path).files["world"]
    pose = np.eye(4)
    pose[:3, 3] = 0, 0, 1
    above = View(str(folder), 160, 120, mount=Mount(0, 0, 30, 0, -90), pose=lambda: pose)
    down = next(cameras.frames("world", above)).image
    up = next(cameras.frames("world", above._replace(mount=Mount(0, 0, 30, 0, 90)))).image
    assert (up == up[0, 0]).all() and not (down == up[0, 0]).all(axis=-1).all()


def test_simulated_camera_shows_splats_unless_surfaces_are_given(tmp_path: Path) -> None:
    scene = synthetic.scene(tmp_path, tiles=1)
    folder = scene.tiles[0].folder.parents[1]
    view = View(str(folder), 160, 120, pose=lambda: np.eye(4))
    plain = next(cameras.frames("world", view)).image
    xyz = np.random.default_rng(1).uniform((2, -6, -1), (6, 6, 6), (3000, 3))  # a green wall before the camera
    splats = Splats.of(
        xyz, np.full((3000, 3), 0.3), np.tile([1.0, 0, 0, 0], (3000, 1)), np.full(3000, 0.9),
        np.tile((0.1, 0.8, 0.2), (3000, 1)),
    )  # fmt: skip
    SplatLayer(splats, np.ones((512, 1024, 3), np.float32)).save(scene.tiles[0].folder / SPLATS_FILE)
    with pytest.raises(UnavailableError, match="surfaces:"):
        next(cameras.frames("world", view))
    opened: list[Path] = []

    def open_world(folder: Path) -> WorldCamera:
        opened.append(folder)
        return WorldCamera(read_scene(folder))

    able = view._replace(open_world=open_world)
    for mount in (Mount(), Mount(yaw=10)):  # two cameras of one world
        frame = next(cameras.frames("world", able._replace(mount=mount)))
        assert frame.image.shape == (120, 160, 3)
        assert np.abs(frame.image[40:80, 60:100].mean(axis=(0, 1)) / 255 - (0.1, 0.8, 0.2)).max() < 0.1
    assert opened == [folder.resolve()], "cameras share the world"
    assert np.array_equal(next(cameras.frames("surfaces", able)).image, plain)


def test_mount_pose_has_the_given_angles() -> None:
    for yaw, pitch, ahead in (
        (0, 0, (1, 0, 0)),
        (90, 0, (0, 1, 0)),
        (180, 0, (-1, 0, 0)),
        (0, 90, (0, 0, 1)),
        (-90, 0, (0, -1, 0)),
    ):
        pose = Mount(1.0, 0.5, 1.5, yaw, pitch).pose()
        assert np.allclose(pose[:3, 2], ahead, atol=1e-9) and np.allclose(pose[:3, 3], (1.0, 0.5, 1.5))
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    assert Mount().pose()[2, 1] < 0  # down in the image is down in the world
