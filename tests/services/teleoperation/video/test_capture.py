from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.teleoperation import cameras, encoders
from scan2sim.services.teleoperation.cameras import Camera, CameraFrame, View
from scan2sim.services.teleoperation.control.messages import VideoStream
from scan2sim.services.teleoperation.video.capture import CameraEncoder, CameraStreamer
from scan2sim.services.teleoperation.video.jitter_buffer import Frame, VideoReceiver
from scan2sim.services.teleoperation.video.rate_control import EncodingPlan
from scan2sim.services.teleoperation.video.srtp_session import KeySchedule
from tests.fakes.virtual_clock import VirtualClock
from tests.services.teleoperation.video.videos import FRAME_INTERVAL_NS, Drive, scenery
from tests.waiting import until


def test_cameras_are_sent_in_parallel_threads() -> None:
    began = time.monotonic_ns()
    keys, frames, threads = KeySchedule(time.monotonic()), dict[int, list[Frame]](), set[str]()
    receiver = VideoReceiver(
        lambda frame: frames.setdefault(frame.camera, []).append(frame),
        lambda camera: None,
        lambda sent: (time.monotonic_ns() - sent) / 1e6,
        lambda source, sequences: None,
        lambda: 0.1,
    )
    for key in keys.announced(time.monotonic()):
        receiver.add_key(key)

    def send(packets: object) -> None:
        threads.add(threading.current_thread().name)
        for packet in packets:  # type: ignore[attr-defined]
            receiver.feed(packet, "lo")

    view = View(width=160, height=120)
    opened = [Camera(name, lambda: cameras.frames("pattern", view)) for name in ("front", "left", "right", "rear")]
    streamers = [
        CameraStreamer(i, camera, CameraEncoder(i, keys, encoders.find("pyav")), send, EncodingPlan(bitrate=300_000))
        for i, camera in enumerate(opened)
    ]
    until(lambda: len(frames) == 4 and min(map(len, frames.values())) > 10)
    assert streamers[2].stream == VideoStream(2, "right", 160, 120, 30.0)
    for streamer, camera in zip(streamers, opened, strict=True):
        streamer.close()
        camera.close()
    assert threads == {"video front", "video left", "video right", "video rear"}
    now = time.monotonic_ns()
    for sent in frames.values():
        assert sent[0].key and all(began <= frame.captured <= now for frame in sent)


def test_only_the_newest_frame_is_kept() -> None:
    go, end, images = threading.Event(), threading.Event(), [np.full((2, 2, 3), i, np.uint8) for i in range(50)]

    def frames() -> Iterator[CameraFrame]:
        for i, image in enumerate(images):
            yield CameraFrame(image, i)
        go.set()
        end.wait()

    camera = Camera("front", frames)
    go.wait()
    newest = camera.read(5.0)
    assert newest and newest.captured == 49 and camera.count == 50
    end.set()
    camera.close()


def test_camera_without_frames_is_offline_and_reopened_after_growing_pauses() -> None:
    clock, pauses, offline, opened = VirtualClock(), list[float](), list[bool](), list[Camera]()

    def frames() -> Iterator[CameraFrame]:
        if len(pauses) == 8:
            yield CameraFrame(np.zeros((2, 2, 3), np.uint8), 0)

    def wait(closed: threading.Event, pause: float) -> bool:
        until(lambda: opened)
        offline.append(opened[0].offline)
        pauses.append(pause)
        clock.sleep(pause)
        return len(pauses) == 11 and closed.wait()

    opened.append(Camera("front", frames, clock=clock, wait=wait))
    until(lambda: len(pauses) == 11)
    opened[0].close()
    assert pauses == pytest.approx([0.2, 0.4, 0.8, 1.6, 3.2, 5, 5, 5, 0.1, 0.2, 0.4])
    # one second without a frame, since its creation and since the frame after the 8th pause
    assert offline == [False, False, False, True, True, True, True, True, False, False, False]


def test_lost_camera_is_reported_and_reopened(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras, "CAMERA_TIMEOUT_S", 0.2)
    connected = threading.Event()
    connected.set()

    def frames() -> Iterator[CameraFrame]:
        if not connected.is_set():
            raise InputError("/dev/video0", "is gone", "Plug it in")
        for frame in scenery(64, 48):
            time.sleep(0.01)
            yield CameraFrame(frame.image, time.monotonic_ns())
            if not connected.is_set():
                raise InputError("/dev/video0", "is gone", "Plug it in")

    sent: list[int] = []
    camera = Camera("front", frames)
    streamer = CameraStreamer(
        1,
        camera,
        CameraEncoder(1, KeySchedule(0.0), encoders.find("pyav")),
        lambda p: sent.append(len(p)),
        EncodingPlan(),
    )
    until(lambda: sent and streamer.stream.fps == 30.0)
    connected.clear()
    until(lambda: streamer.stream.fps == 0.0 and camera.fault == "/dev/video0: is gone. Plug it in")
    connected.set()
    before = len(sent)
    until(lambda: len(sent) > before and streamer.stream.fps == 30.0 and not camera.fault)
    streamer.close()
    camera.close()


def test_frames_are_dropped_to_the_planned_frame_rate() -> None:
    for fps, expected in ((30.0, 90), (20.0, 60), (15.0, 45), (7.5, 23)):
        drive = Drive(plan=EncodingPlan(bitrate=500_000, fps=fps))
        drive.send(frame for _, frame in zip(range(90), scenery(64, 48), strict=False))
        assert len(drive.frames) == pytest.approx(expected, abs=1)
        gaps = np.diff([frame.captured for frame in drive.frames]) / FRAME_INTERVAL_NS
        assert gaps.max() <= 30 / fps + 1.01


def test_frame_dropped_by_the_encoder_is_not_counted_as_loss() -> None:
    chance = np.random.default_rng(0)
    drive = Drive(plan=EncodingPlan(bitrate=100_000))
    noise = chance.integers(0, 255, (60, 240, 320, 3), np.uint8)
    drive.send(CameraFrame(image, i * FRAME_INTERVAL_NS) for i, image in enumerate(noise))
    counts = drive.receiver.frames()[3]
    assert drive.encoder.counts["skipped"] > 5 and len(drive.frames) == drive.encoder.counts["frames"]
    assert (counts["broken"], counts["lost"]) == (0, 0) and not drive.key_frame_requests and drive.in_order()


def test_new_encoder_is_created_when_the_bit_rate_changes() -> None:
    drive, frames = Drive(plan=EncodingPlan(bitrate=1_000_000)), scenery(64, 48)
    for bitrate, created in ((1_000_000, 1), (1_000_000, 1), (800_000, 2), (1_000_000, 3)):
        drive.plan = EncodingPlan(bitrate=bitrate)
        drive.send(next(frames) for _ in range(5))
        assert drive.encoder.counts["encoders"] == created
    assert len(drive.frames) == 20 and not drive.key_frame_requests


def test_failed_encoder_is_reported_and_replaced() -> None:
    broken = threading.Event()

    class Backend:
        RANK = 0

        def unavailable(self) -> None:
            return None

        def encoder(self, settings: encoders.EncoderSettings) -> encoders.Encoder:
            if broken.is_set():
                raise OSError("the encoder is hot")
            working: encoders.Encoder = encoders.find("pyav").encoder(settings)

            class FailingEncoder:
                def encode(self, planes: U8, captured: int, key: bool) -> bytes:
                    if broken.is_set():
                        raise OSError("the encoder is hot")
                    return working.encode(planes, captured, key)

                def close(self) -> None:
                    working.close()

            return FailingEncoder()

    sent: list[int] = []
    camera = Camera("front", lambda: cameras.frames("pattern", View(width=64, height=48)))
    streamer = CameraStreamer(
        0, camera, CameraEncoder(0, KeySchedule(0.0), Backend()), lambda p: sent.append(len(p)), EncodingPlan()
    )
    until(lambda: sent)
    broken.set()
    until(lambda: streamer.fault == "the encoder is hot" and streamer.stream.fps == 0.0)
    broken.clear()
    before = len(sent)
    until(lambda: len(sent) > before and not streamer.fault and streamer.encoder.counts["encoders"] == 2)
    streamer.close()
    camera.close()
