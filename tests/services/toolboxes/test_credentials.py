"""Camera credentials are sent to the camera only: not in status, detections, results, logs or errors."""

from __future__ import annotations

import base64
import json
import logging
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytest.importorskip("fastapi", reason="the extra bus isn't installed")
from fastapi.testclient import TestClient

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.toolboxes import offline, sources
from scan2sim.services.toolboxes.api import application
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.per_source_worker import SourceWorker
from scan2sim.services.toolboxes.results import SCHEMA, Body, Result
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.sources import Cameras
from tests.fakes.ports import free_port
from tests.services.toolboxes import shaky
from tests.waiting import until

USER, PASSWORD, TOKEN = "admin", "hunter2", "s3cret"


class _Camera(BaseHTTPRequestHandler):
    """Camera that streams JPEGs to clients with the password and the token."""

    def do_GET(self) -> None:
        import cv2

        expected = "Basic " + base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()
        if self.headers.get("Authorization") != expected or f"token={TOKEN}" not in urlsplit(self.path).query:
            self.send_response(401)
            self.send_header("WWW-Authenticate", 'Basic realm="camera"')
            self.end_headers()
            return
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        jpeg = cv2.imencode(".jpg", shaky.image(50, (48, 64)))[1].tobytes()
        part = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode() + jpeg + b"\r\n"
        try:
            while True:
                self.wfile.write(part)
                time.sleep(0.02)
        except OSError:
            pass

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    made = Engine(shaky.__name__, ToolboxParams(deadline=offline.OFFLINE_DEADLINE_S))
    yield made
    made.close()


@pytest.fixture
def port() -> Iterator[int]:
    """Port of a camera that requires user, password and token."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Camera)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.server_port
    server.shutdown()
    server.server_close()


def url(port: int, path: str = "live") -> str:
    return f"http://{USER}:{PASSWORD}@127.0.0.1:{port}/{path}?token={TOKEN}"


def redacted_url(port: int, path: str = "live") -> str:
    return f"http://***@127.0.0.1:{port}/{path}?token=***"


def check_no_secrets(*texts: str) -> None:
    for text in texts:
        assert not any(secret in text for secret in (PASSWORD, TOKEN)), text


def test_status_and_detections_name_a_camera_without_its_credentials(
    engine: Engine, port: int, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    caplog.set_level(logging.DEBUG, logger="scan2sim")
    cameras = Cameras(engine, [url(port)])
    client = TestClient(application(engine, ServerParams(), cameras), base_url="http://localhost")
    try:
        started = client.post("/start").text
        until(lambda: client.get("/detections").json())
        status, detections = client.get("/status"), client.get("/detections")
        assert (
            list(status.json()["cameras"]) == [redacted_url(port)]
            and status.json()["cameras"][redacted_url(port)]["connected"]
        )
        assert [one["source"] for one in detections.json()] == [redacted_url(port)]
        assert detections.json()[0]["schema"] == SCHEMA, "spelled as in all other results"
        label = detections.json()[0]["body"]["classes"][0]["label"]
        assert 49 <= int(label) <= 51, "the reader uses the original address"
        for source in (redacted_url(port), url(port)):
            assert len(client.get("/detections", params={"source": source}).json()) == 1
        check_no_secrets(started, status.text, detections.text, client.get("/metrics").text)
        check_no_secrets(" ".join(thread.name for thread in threading.enumerate()))
    finally:
        stopped = client.post("/stop").text
    check_no_secrets(stopped, caplog.text, *capfd.readouterr())


def test_cameras_that_differ_only_in_credentials_have_separate_names(engine: Engine) -> None:
    addresses = [url(9), url(9).replace(PASSWORD, "other"), url(9, "rear"), "0"]
    cameras = Cameras(engine, addresses)
    assert list(cameras.states()) == [redacted_url(9), f"{redacted_url(9)} (2)", redacted_url(9, "rear"), "0"]


@pytest.mark.parametrize("scheme", ["http", "rtsp"])
def test_unreachable_camera_is_logged_once_without_its_credentials(
    engine: Engine,
    scheme: str,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    attempts: list[object] = []
    monkeypatch.setattr(sources, "_read", attempts.append)  # delivers no image
    closed = free_port()
    cameras = Cameras(engine, [url(closed).replace("http", scheme)])
    name = redacted_url(closed).replace("http", scheme)
    cameras.start()
    try:
        until(lambda: name in caplog.text and len(attempts) >= 3)  # it is retried
        assert cameras.states() == {name: {"connected": False, "images": 0}}
    finally:
        cameras.stop()
    assert caplog.text.count("delivers no images") == 1
    check_no_secrets(caplog.text, *capfd.readouterr())


def test_results_name_a_source_without_its_credentials(engine: Engine) -> None:
    client = TestClient(application(engine, ServerParams()), base_url="http://localhost")
    headers = {"Content-Type": "image/jpeg", "Source": url(80)}
    refused = client.post(f"/v2/models/{engine.name}/infer", content=b"no image", headers=headers)
    assert refused.status_code == 422 and refused.json()["source"] == redacted_url(80)
    tensor = {"name": "i", "datatype": "UINT8", "shape": [1, 1, 3], "data": [7, 7, 7]}
    asked = {"inputs": [tensor], "parameters": {"source": url(80)}}
    (done,) = client.post(f"/v2/models/{engine.name}/infer", json=asked).json()["outputs"][0]["data"]
    assert json.loads(done)["source"] == redacted_url(80)


def test_results_file_holds_no_credentials(engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    folder = tmp_path / "http:" / f"{USER}:{PASSWORD}@camera"  # like a mirror of a camera's recordings
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "1.png"), shaky.image(10))
    monkeypatch.chdir(tmp_path)
    offline.process_files(engine, folder.relative_to(tmp_path), tmp_path / "out", silent)
    (line,) = (tmp_path / "out" / offline.RESULTS_FILE).read_text(encoding="utf-8").splitlines()
    assert json.loads(line)["source"] == "http:/***@camera"


@pytest.mark.parametrize("read", [sources.count, lambda path: list(sources.stored_images(path))])
def test_address_instead_of_a_file_is_rejected_without_its_credentials(read: Callable[[Path], object]) -> None:
    with pytest.raises(InputError, match="not found") as caught:
        read(Path(url(80)))
    check_no_secrets(str(caught.value), repr(caught.value))


def test_failing_source_worker_logs_no_credentials(caplog: pytest.LogCaptureFixture) -> None:
    def fail(frame: Frame, image: object, body: Body) -> Body:
        raise ValueError("no features")

    def ignore(result: Result) -> None:
        pass

    ended: list[Body | str] = []
    worker = SourceWorker(url(80), fail)
    frame = Frame("1", url(80), None, shaky.image(1), ignore)
    worker.put(frame, shaky.image(1), Body(), ended.append)
    names = " ".join(thread.name for thread in threading.enumerate())
    worker.close()
    assert ended and redacted_url(80) in caplog.text and redacted_url(80) in names
    check_no_secrets(caplog.text, names)
