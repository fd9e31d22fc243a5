"""A recorded drive has what was seen and commanded, stays within its size, and is replayed on the driver page."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import cv2
import pytest
from typer.testing import CliRunner

pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
pytest.importorskip("rosbags", reason="the extra bus isn't installed")
pytest.importorskip("fastapi", reason="the extra bus isn't installed")

from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.services.http import factory
from scan2sim.services.teleoperation.control.controls import Controls, Gear
from scan2sim.services.teleoperation.control.messages import Command
from scan2sim.services.teleoperation.encoders import Decoder
from scan2sim.services.teleoperation.settings import ReplayParams
from scan2sim.services.teleoperation.station import replay
from scan2sim.services.teleoperation.station.recorder import PREFIX, Recorder, bag_name, read
from scan2sim.services.teleoperation.station.web import record
from scan2sim.services.teleoperation.video.jitter_buffer import Frame
from tests.fakes.browser import chromium
from tests.services.teleoperation.street import Street
from tests.waiting import until


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Path, list[Frame], list[Command]]:
    """Folder of a recorded drive; the frames and commands that were recorded."""
    street, folder, frames, commands = Street(tmp_path), tmp_path / "drives", list[Frame](), list[Command]()
    try:
        desk = street.desk()
        station = desk.station
        street.fleet.join("car", "desk", "operator")
        until(lambda: desk.streams())
        recorder = Recorder(folder, 1e9, station.snapshot, station.request_key_frames)

        def show(frame: Frame) -> None:
            frames.append(frame)
            joined = station.joined()
            assert joined is not None
            recorder.frame("front", frame, joined.age(frame.captured))

        desk.show = show
        record(station, recorder)
        send = station.record_command

        def send_and_keep(command: Command) -> None:
            commands.append(command)
            send(command)

        station.record_command = send_and_keep
        desk.start()
        until(lambda: any(frame.key for frame in frames[:-20]))  # the stream may have begun before it was recorded
        station.driver_session.latch("the test")
        until(lambda: commands and commands[-1].emergency)
        desk.drive(None)
        station.driver_session.release("script", "the end")
    finally:
        street.close()
    recorder.close()
    return folder, frames, commands


def test_recorded_drive_replays_to_the_same_commands_and_pictures(
    recorded: tuple[Path, list[Frame], list[Command]], tmp_path: Path
) -> None:
    folder, frames, commands = recorded
    found = list(read(folder))
    assert [one.at for one in found] == sorted(one.at for one in found)
    assert [one.content for one in found if one.topic == "/command"] == commands and commands[-1].emergency
    seen = [one for one in found if one.topic == "/video/front"]
    assert [one.content.data for one in seen] == [frame.data for frame in frames]
    assert [one.content.key for one in seen] == [frame.key for frame in frames] and any(one.content.key for one in seen)
    assert all(0 <= one.at - one.content.captured < 5e9 for one in seen)
    events = [one.content["what"] for one in found if one.topic == "/event"]
    assert events[0].startswith("take control") or "confirm stop" in events[0]
    assert "press emergency stop" in events
    states = [one.content for one in found if one.topic == "/state"]
    assert states[-1]["station"] == "desk" and any(one.get("vehicle") == "car" for one in states)
    params = ReplayParams(recording=folder, port=0)
    urls: list[str] = []
    page_app = replay.application(params)
    threading.Thread(target=factory.run, args=(page_app, params, urls.append), daemon=True).start()
    until(lambda: urls)
    with chromium(tmp_path) as page:
        page.do("Page.navigate", url=urls[0])
        page.until("document.querySelector('figure')?.dataset.shown > 5")
        page.until("byId('status').textContent === 'live' && byId('standing').textContent.includes('driver: script')")
        page.value("send({do: 'stop'}), 0")
        page.until("byId('fault').textContent.includes('recorded drive')")
        assert not page.errors


def test_exported_drive_has_jpeg_images_that_viewers_show(
    recorded: tuple[Path, list[Frame], list[Command]], tmp_path: Path
) -> None:
    folder, frames, commands = recorded
    out, decoder = tmp_path / "exported", Decoder()
    exported = CliRunner().invoke(app, ["teleop", "export", str(folder), str(out), "--rate", "60"])
    assert exported.exit_code == 0, exported.output
    interval, due, decoded = 1e9 / 60, 0.0, list[Any]()
    for frame in frames:
        picture = decoder.decode(frame.data)  # None before the first key frame
        if picture is not None and frame.captured >= due:
            decoded.append(picture)
            due = max(due, frame.captured - interval) + interval  # frames of a busy machine come in bursts
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(out) as reader:
        types = {one.topic: one.msgtype for one in reader.connections}
        images: list[Any] = [
            store.deserialize_cdr(data, one.msgtype)
            for one, _, data in reader.messages()
            if one.topic == "/video/front/compressed"
        ]
        sent = sum(one.topic == "/command" for one, _, _ in reader.messages())
    assert types["/video/front/compressed"] == "sensor_msgs/msg/CompressedImage" and sent == len(commands)
    assert len(decoded) > 1 and {(one.format, one.header.frame_id) for one in images} == {("jpeg", "front")}
    shown: list[Any] = [cv2.imdecode(one.data, cv2.IMREAD_COLOR) for one in images]
    assert all(cv2.PSNR(one[..., ::-1], picture) > 25 for one, picture in zip(shown, decoded, strict=True))
    again = CliRunner().invoke(app, ["teleop", "export", str(folder), str(out)])
    assert isinstance(again.exception, SettingError) and again.exception.cause == "exists"


def test_oldest_drives_are_deleted_beyond_the_limit(tmp_path: Path) -> None:
    limit = 4e6
    recorder = Recorder(tmp_path, limit, dict)
    for number in range(120):
        recorder.frame("front", Frame(0, number, number == 0, bytes(100_000), 640, 480), 10.0)
        recorder.command(Command(Controls(number / 200, gear=Gear.FORWARD), number))
        until(recorder._queue.empty)
    recorder.close()
    assert sum(file.stat().st_size for file in tmp_path.rglob("*.mcap")) < 1.2 * limit
    stops = [one.content.stop for one in read(tmp_path) if one.topic == "/command"]
    assert stops[-1] == 119 and stops == list(range(stops[0], 120)) and stops[0] > 50, "the newest, without gaps"
    assert len(list(tmp_path.glob(f"{PREFIX}*"))) > 3 and recorder.dropped == 0


def test_names_of_bags_are_in_order_of_time() -> None:
    names = [bag_name(ms) for ms in range(58_990, 61_010)]  # into the next minute
    assert names == sorted(set(names)) and names[1010] == "drive-19700101-000100-000"


def test_missing_and_damaged_recordings_are_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="contains no recorded drive"):
        list(read(tmp_path))
    recorder = Recorder(tmp_path, 1e9, dict)
    recorder.command(Command(Controls()))
    recorder.close()
    file = next(tmp_path.rglob("*.mcap"))
    file.write_bytes(b"junk")
    with pytest.raises(InputError, match="can't be read"):
        list(read(tmp_path))
