"""Clients of a running toolbox: Triton's own, several at once, slow ones, and ones that disconnect."""

from __future__ import annotations

import gzip
import io
import json
import logging
import select
import socket
import subprocess
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from email.message import Message
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("fastapi", reason="the extra bus isn't installed")
pytest.importorskip("grpc", reason="the extra toolboxes isn't installed")

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.toolboxes.api import application
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.inference import grpc_server
from scan2sim.services.toolboxes.settings import ToolboxParams
from tests.fakes.interpreters import TRITON_PYTHON
from tests.fakes.toolbox_clients import call_by_triton, slow_posts
from tests.services.toolboxes import shaky
from tests.services.toolboxes.model_wait import ModelWait
from tests.services.toolboxes.shaky import SLOW, image
from tests.waiting import until

TASK = shaky.__name__
PATH = f"/v2/models/{TASK}/infer"


@dataclass(frozen=True)
class Served:
    """A running toolbox."""

    engine: Engine
    wait: ModelWait
    port: int
    grpc_address: str

    def url(self, path: str = PATH) -> str:
        return f"http://127.0.0.1:{self.port}{path}"


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    """A toolbox with the usual settings, by HTTP and gRPC."""
    wait = ModelWait()
    engine, params, addresses = Engine(TASK, ToolboxParams(deadline=5), wait=wait), ServerParams(port=0), list[str]()
    app = application(engine, params)
    threading.Thread(target=factory.run, args=(app, params, addresses.append), daemon=True).start()
    with grpc_server.serving(engine, params, 0) as grpc_address:
        until(lambda: addresses)
        yield Served(engine, wait, int(addresses[0].rsplit(":")[-1].strip("/")), grpc_address)
    engine.close()


def encoded(level: int, kind: str = "PNG") -> bytes:
    out = io.BytesIO()
    Image.fromarray(image(level, (16, 16))).save(out, kind)
    return out.getvalue()


def pixels(level: int, count: int) -> bytes:
    """A request with the same image several times, as binary tensor data."""
    shape = [count, 8, 8, 3]
    data = np.full(shape, level, np.uint8).tobytes()
    tensor = {"name": "pixels", "datatype": "UINT8", "shape": shape, "parameters": {"binary_data_size": len(data)}}
    return json.dumps({"inputs": [tensor]}).encode() + data


def post(url: str, body: bytes, **headers: str) -> tuple[int, dict[str, Any], Message]:
    """Status, JSON and headers of the response."""
    if b"binary_data_size" in body:
        headers["Inference-Header-Content-Length"] = str(body.index(b"]}") + 2)
    request = urllib.request.Request(url, body, {name.replace("_", "-"): value for name, value in headers.items()})
    try:
        with urllib.request.urlopen(request, timeout=60) as response:
            return response.status, json.load(response), response.headers
    except urllib.error.HTTPError as error:
        return error.code, json.load(error), error.headers


def test_triton_client_makes_all_its_calls(served: Served, tmp_path: Path) -> None:
    if not TRITON_PYTHON.exists():
        pytest.skip("Triton's client isn't installed (.venv-triton, tests/services/toolboxes/triton-requirements.txt)")
    files = [tmp_path / name for name in ("1.png", "2.jpg", "3.webp")]
    for file, kind in zip(files, ("PNG", "JPEG", "WEBP"), strict=True):
        file.write_bytes(encoded(50, kind))
    found = call_by_triton(TASK, served.port, served.grpc_address, files)
    assert found["calls"] > 80 and not found["failed"], found["failed"]


def test_large_requests_of_several_clients_are_served_and_do_not_delay_a_small_one(served: Served) -> None:
    """64 slow images in a request take longer than the deadline of one; a single image needn't wait for them."""
    with ThreadPoolExecutor() as pool:
        served.wait.hold()
        large = pool.submit(post, served.url(), pixels(SLOW, 64))
        until(lambda: served.engine.waiting()[0] == 63)
        small = pool.submit(post, served.url(), encoded(7), Content_Type="image/png")
        until(lambda: served.engine.waiting()[0] == 64)
        served.wait.let_pass(3)  # the image in the model, one more of the same client, and the small one
        status, response, _ = small.result(60)
        assert status == 200 and response["state"] == "done"
        assert served.engine.waiting()[0] > 60
        served.wait.release()
        status, response, _ = large.result()
    assert status == 200 and [json.loads(one)["state"] for one in response["outputs"][0]["data"]] == ["done"] * 64


def test_requests_beyond_a_clients_queue_are_rejected_with_the_time_to_retry(served: Served) -> None:
    with ThreadPoolExecutor() as pool:
        served.wait.hold()
        accepted = [pool.submit(post, served.url(), pixels(1, 60)) for _ in range(2)]
        until(lambda: served.engine.waiting()[0] == 119)
        status, response, headers = post(served.url(), pixels(1, 64))
        served.wait.release()
        assert status == 429 and "128 images" in response["error"] and 0 < int(headers["Retry-After"]) <= 60
        assert [one.result()[0] for one in accepted] == [200, 200]
    assert post(served.url(), pixels(1, 64))[0] == 200
    assert f"scan2sim_frames_rejected_total {64.0}" in urllib.request.urlopen(served.url("/metrics")).read().decode()


def test_slow_bodies_do_not_delay_health_or_other_callers(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with slow_posts(served.port, PATH) as posts:
        for _ in range(5):
            for path in ("/health/live", "/health/ready", "/v2/health/live", "/v2/health/ready"):
                assert urllib.request.urlopen(served.url(path), timeout=60).status == 200, path
            assert post(served.url(), encoded(9), Content_Type="image/png")[0] == 200
            assert post(served.url(), pixels(9, 8))[0] == 200
        assert not select.select(posts, [], [], 0)[0], "all of this while every slow post was open"
    until(lambda: caplog.text.count("the client has disconnected") == len(posts))
    assert len(caplog.records) == len(posts), "one line each"


def test_disconnected_client_costs_one_line_of_log_and_no_inference(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    body = pixels(1, 64)
    header = f"POST {PATH} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n"
    json_bytes = body.index(b"]}") + 2
    executed = served.engine.counts["executions"]
    served.wait.hold()
    with caplog.at_level(logging.INFO):
        for number, sent in enumerate((body[:1000], body), 1):
            with socket.create_connection(("127.0.0.1", served.port)) as connection:
                connection.sendall(f"{header}Inference-Header-Content-Length: {json_bytes}\r\n\r\n".encode() + sent)
                until(lambda: served.engine.waiting()[0] == (63 if sent is body else 0))  # noqa: B023
            until(lambda: caplog.text.count("the client has disconnected") == number)  # noqa: B023
        served.wait.release()
        until(lambda: served.engine.waiting()[0] == 0)
    assert "Traceback" not in caplog.text and len(caplog.records) == 2
    assert served.engine.counts["executions"] - executed <= 1


def test_json_is_limited_in_values_and_compression_in_size(served: Served) -> None:
    numbers = {"name": "i", "datatype": "UINT8", "shape": [1000, 1000, 3], "data": [1] * 3_000_000}
    status, response, _ = post(
        served.url(), json.dumps({"inputs": [numbers]}).encode(), Content_Type="application/json"
    )
    assert status == 422 and "binary tensor data" in response["error"]
    for bomb in (gzip.compress(bytes(10**8)), b"no gzip", gzip.compress(b"{}")[:-5]):
        assert post(served.url(), bomb, Content_Encoding="gzip")[0] == 422
    assert post(served.url(), b"x", Content_Encoding="br")[0] == 415


def test_errors_have_the_field_that_clients_of_the_protocol_read(served: Served) -> None:
    for path, body in (("/v2/models/other/infer", b"{}"), (PATH, b"{}"), (PATH, b"{"), ("/v2/repository/nix", b"{}")):
        status, response, _ = post(served.url(path), body, Content_Type="application/json")
        assert status in (404, 422) and response["error"], path


def test_grpc_requires_the_token(served: Served, tmp_path: Path) -> None:
    import grpc

    (tmp_path / "token").write_text("0123456789abcdef", encoding="utf-8")
    params = ServerParams(token=tmp_path / "token")
    with grpc_server.serving(served.engine, params, 0) as address, grpc.insecure_channel(address) as channel:
        live = channel.unary_unary("/inference.GRPCInferenceService/ServerLive")
        for metadata in ((), (("authorization", "Bearer wrong"),)):
            with pytest.raises(grpc.RpcError) as caught:
                live(b"", metadata=metadata, timeout=60)
            assert caught.value.code() == grpc.StatusCode.UNAUTHENTICATED
        assert live(b"", metadata=(("authorization", "Bearer 0123456789abcdef"),), timeout=60) == b"\x08\x01"


def test_grpc_uses_the_certificate(served: Served, tmp_path: Path) -> None:
    import grpc

    paths = tmp_path / "certificate.pem", tmp_path / "key.pem"
    command = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj /CN=localhost"
    names = ("-addext", "subjectAltName=DNS:localhost", "-out", paths[0], "-keyout", paths[1])
    subprocess.run(["openssl", *command.split(), *names], check=True, capture_output=True)
    params = ServerParams(host="localhost", certificate=paths[0], key=paths[1])
    credentials = grpc.ssl_channel_credentials(paths[0].read_bytes())
    with grpc_server.serving(served.engine, params, 0) as address, grpc.secure_channel(address, credentials) as channel:
        assert channel.unary_unary("/inference.GRPCInferenceService/ServerLive")(b"", timeout=60) == b"\x08\x01"


def test_grpc_port_in_use_is_reported(served: Served) -> None:
    port = int(served.grpc_address.rpartition(":")[2])
    with (
        pytest.raises(SettingError, match="Choose another port"),
        grpc_server.serving(served.engine, ServerParams(), port),
    ):
        pass
