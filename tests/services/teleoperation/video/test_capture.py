from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.teleoperation import cameras, encoders
from scan2sim.services.teleoperation.cameras import Camera, Picture, View
from scan2sim.services.teleoperation.control.messages import Stream
from scan2sim.services.teleoperation.video.capture import Coder, Streamer
from scan2sim.services.teleoperation.video.jitter_buffer import Frame, Watcher
from scan2sim.services.teleoperation.video.rate_control import Plan
from scan2sim.services.teleoperation.video.srtp_session import Keys
from tests.services.teleoperation.video.videos import STEP, Drive, scenery


def wait(until: object, seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not until():  # type: ignore[operator]
        assert time.monotonic() < end
        time.sleep(0.01)


def test_cameras_are_sent_side_by_side() -> None:
    keys, frames, threads = Keys(time.monotonic()), dict[int, list[Frame]](), set[str]()
    watcher = Watcher(
        lambda frame: frames.setdefault(frame.camera, []).append(frame),
        lambda camera: None,
        lambda sent: (time.monotonic_ns() - sent) / 1e6,
        lambda source, sequences: None,
        lambda: 0.1,
    )
    for key in keys.told(time.monotonic()):
        watcher.learn(key)

    def send(packets: object) -> None:
        threads.add(threading.current_thread().name)
        for packet in packets:  # type: ignore[attr-defined]
            watcher.feed(packet, "lo")

    view = View(width=160, height=120)
    opened = [Camera(name, lambda: cameras.pictures("pattern", view)) for name in ("front", "left", "right", "rear")]
    streamers = [
        Streamer(i, camera, Coder(i, keys, encoders.find("pyav")), send, Plan(bitrate=300_000))
        for i, camera in enumerate(opened)
    ]
    wait(lambda: len(frames) == 4 and min(map(len, frames.values())) > 10)
    assert streamers[2].stream == Stream(2, "right", 160, 120, 30.0)
    for streamer, camera in zip(streamers, opened, strict=True):
        streamer.close()
        camera.close()
    assert threads == {"video front", "video left", "video right", "video rear"}
    now = time.monotonic_ns()
    for sent in frames.values():
        assert sent[0].key and all(0 < now - frame.captured < 60e9 for frame in sent)


def test_the_newest_picture_wins() -> None:
    go, images = threading.Event(), [np.full((2, 2, 3), i, np.uint8) for i in range(50)]

    def pictures() -> Iterator[Picture]:
        for i, image in enumerate(images):
            yield Picture(image, i)
        go.set()
        threading.Event().wait(0.5)

    camera = Camera("front", pictures)
    go.wait(5)
    newest = camera.read(5.0)
    assert newest and newest.captured == 49 and camera.count >= 50
    camera.close()


def test_a_camera_that_vanishes_is_told_and_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras, "SILENT", 0.2)
    there = threading.Event()
    there.set()

    def pictures() -> Iterator[Picture]:
        if not there.is_set():
            raise InputError("/dev/video0", "is gone", "Plug it in")
        for picture in scenery(64, 48):
            time.sleep(0.01)
            yield Picture(picture.image, time.monotonic_ns())
            if not there.is_set():
                raise InputError("/dev/video0", "is gone", "Plug it in")

    sent: list[int] = []
    camera = Camera("front", pictures)
    streamer = Streamer(1, camera, Coder(1, Keys(0.0), encoders.find("pyav")), lambda p: sent.append(len(p)), Plan())
    wait(lambda: sent)
    assert streamer.stream.fps == 30.0
    there.clear()
    wait(lambda: streamer.stream.fps == 0.0)
    assert camera.fault == "/dev/video0: is gone. Plug it in"
    there.set()
    before = len(sent)
    wait(lambda: len(sent) > before and streamer.stream.fps == 30.0 and not camera.fault)
    streamer.close()
    camera.close()


def test_pictures_are_left_out_for_the_rate() -> None:
    for fps, kept in ((30.0, 90), (20.0, 60), (15.0, 45), (7.5, 23)):
        drive = Drive(plan=Plan(bitrate=500_000, fps=fps))
        drive.send(picture for _, picture in zip(range(90), scenery(64, 48), strict=False))
        assert len(drive.frames) == pytest.approx(kept, abs=1)
        gaps = np.diff([frame.captured for frame in drive.frames]) / STEP
        assert gaps.max() <= 30 / fps + 1.01


def test_a_frame_that_the_encoder_leaves_out_is_no_loss() -> None:
    chance = np.random.default_rng(0)
    drive = Drive(plan=Plan(bitrate=100_000))
    noise = chance.integers(0, 255, (60, 240, 320, 3), np.uint8)
    drive.send(Picture(image, i * STEP) for i, image in enumerate(noise))
    counts = drive.watcher.frames()[3]
    assert drive.coder.counts["skipped"] > 5 and len(drive.frames) == drive.coder.counts["frames"]
    assert (counts["broken"], counts["lost"]) == (0, 0) and not drive.wanted and drive.in_order()


def test_an_encoder_is_made_anew_where_the_rate_changes() -> None:
    drive, pictures = Drive(plan=Plan(bitrate=1_000_000)), scenery(64, 48)
    for bitrate, made in ((1_000_000, 1), (1_000_000, 1), (800_000, 2), (1_000_000, 3)):
        drive.plan = Plan(bitrate=bitrate)
        drive.send(next(pictures) for _ in range(5))
        assert drive.coder.counts["encoders"] == made
    assert len(drive.frames) == 20 and not drive.wanted


def test_an_encoder_that_fails_is_told_and_another_takes_over() -> None:
    broken = threading.Event()

    class Backend:
        RANK = 0

        def lacking(self) -> None:
            return None

        def encoder(self, settings: encoders.Settings) -> encoders.Encoder:
            if broken.is_set():
                raise OSError("the encoder is hot")
            made: encoders.Encoder = encoders.find("pyav").encoder(settings)

            class Breaks:
                def encode(self, planes: U8, captured: int, key: bool) -> bytes:
                    if broken.is_set():
                        raise OSError("the encoder is hot")
                    return made.encode(planes, captured, key)

                def close(self) -> None:
                    made.close()

            return Breaks()

    sent: list[int] = []
    camera = Camera("front", lambda: cameras.pictures("pattern", View(width=64, height=48)))
    streamer = Streamer(0, camera, Coder(0, Keys(0.0), Backend()), lambda p: sent.append(len(p)), Plan())
    wait(lambda: sent)
    broken.set()
    wait(lambda: streamer.fault == "the encoder is hot" and streamer.stream.fps == 0.0)
    broken.clear()
    before = len(sent)
    wait(lambda: len(sent) > before and not streamer.fault and streamer.coder.counts["encoders"] == 2)
    streamer.close()
    camera.close()
