"""HTTP API of a toolbox: Open Inference Protocol, error responses, access control."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("fastapi", reason="the extra bus isn't installed")
from fastapi.testclient import TestClient

from scan2sim.services.http.settings import ServerParams
from scan2sim.services.toolboxes.api import application
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.inference.tensors import MAX_REQUEST_BYTES
from scan2sim.services.toolboxes.settings import ToolboxParams
from tests.services.toolboxes import shaky
from tests.services.toolboxes.shaky import FAILS, image

TASK = shaky.__name__
INFER = f"/v2/models/{TASK}/infer"


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    made = Engine(TASK, ToolboxParams(waiting=100, deadline=600))
    yield made
    made.close()


@pytest.fixture(scope="module")
def client(engine: Engine) -> TestClient:
    return TestClient(application(engine, ServerParams()), base_url="http://localhost")


def jpeg(level: int) -> bytes:
    out = io.BytesIO()
    Image.fromarray(image(level, (16, 16))).save(out, "JPEG")
    return out.getvalue()


def png(width: int, height: int) -> bytes:
    out = io.BytesIO()
    Image.new("L", (width, height)).save(out, "PNG")
    return out.getvalue()


def request(*tensors: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"inputs": list(tensors), **more}


def bytes_tensor(*pictures: bytes) -> dict[str, Any]:
    data = [base64.b64encode(one).decode() for one in pictures]
    return {"name": "images", "datatype": "BYTES", "shape": [len(data)], "data": data}


def level(result: dict[str, Any]) -> int:
    return int(result["body"]["classes"][0]["label"])


def test_image_file_is_posted(client: TestClient) -> None:
    headers = {"Content-Type": "image/jpeg", "Frame-Id": "f7", "Source": "front", "Stamp": "123"}
    answer = client.post(INFER, content=jpeg(40), headers=headers)
    result = answer.json()
    assert answer.status_code == 200 and abs(level(result) - 40) <= 1
    assert (result["id"], result["source"], result["stamp"], result["size"]) == ("f7", "front", 123, [16, 16])


def test_images_are_posted_as_json_of_the_protocol(client: TestClient) -> None:
    raw = {"name": "raw", "datatype": "UINT8", "shape": [4, 4, 3], "data": image(9, (4, 4)).ravel().tolist()}
    answer = client.post(INFER, json=request(bytes_tensor(jpeg(10), jpeg(20)), raw, id="r1"))
    response = answer.json()
    assert answer.status_code == 200 and response["id"] == "r1" and response["model_name"] == TASK
    (output,) = response["outputs"]
    assert output["datatype"] == "BYTES" and output["shape"] == [3]
    assert [round(level(json.loads(one)), -1) for one in output["data"]] == [10, 20, 10]


def test_model_metadata_and_health(client: TestClient) -> None:
    metadata = client.get(f"/v2/models/{TASK}").json()
    assert metadata["parameters"]["licence"] == "none"
    assert [one["datatype"] for one in metadata["inputs"]] == ["BYTES", "UINT8"]
    for path in ("/v2/health/live", "/v2/health/ready", f"/v2/models/{TASK}/ready", "/health/ready"):
        assert client.get(path).status_code == 200
    assert client.get("/v2").json()["name"] == "scan2sim"
    assert "scan2sim_frames_total" in client.get("/metrics").text
    assert INFER.replace(TASK, "{name}") in client.get("/openapi.json").json()["paths"]


@pytest.mark.parametrize(
    ("content", "kind", "status"),
    [
        (b"no jpeg", "image/jpeg", 422),
        (b"\xff\xd8\xff\xe0", "image/jpeg", 422),
        (b"", "image/png", 422),
        (b"GIF89a", "image/gif", 415),
        (b"x", "text/plain", 415),
        (b"{", "application/json", 422),
        (b"[]", "application/json", 422),
        (json.dumps(request()).encode(), "application/json", 422),
        (json.dumps(request(bytes_tensor(*[b"x"] * 65))).encode(), "application/json", 422),
        (json.dumps(request({**bytes_tensor(b"x"), "shape": [2]})).encode(), "application/json", 422),
        (json.dumps(request({**bytes_tensor(), "data": ["?"], "shape": [1]})).encode(), "application/json", 422),
        (json.dumps(request({**bytes_tensor(), "datatype": "FP32", "data": [1.0], "shape": [1]})).encode(),
         "application/json", 422),
        (json.dumps(request({"name": "i", "datatype": "UINT8", "shape": [20000, 20000, 3], "data": [1]})).encode(),
         "application/json", 422),
        (json.dumps(request({"name": "i", "datatype": "UINT8", "shape": [1, 1, 3], "data": [1, 2, 999]})).encode(),
         "application/json", 422),
        (bytes(MAX_REQUEST_BYTES + 1), "image/jpeg", 413),
        (png(1_000_000, 1), "image/png", 422),
        (png(1, 1_000_000), "image/png", 422),
        (json.dumps(request({"name": "i", "datatype": "UINT8", "shape": [1, 101, 3], "data": [1] * 303})).encode(),
         "application/json", 422),
    ],
)  # fmt: skip
def test_invalid_requests_are_rejected(client: TestClient, content: bytes, kind: str, status: int) -> None:
    answer = client.post(INFER, content=content, headers={"Content-Type": kind})
    assert answer.status_code == status and "Traceback" not in answer.text
    assert client.post(INFER, content=jpeg(5), headers={"Content-Type": "image/jpeg"}).status_code == 200


@pytest.mark.parametrize("name", ["other", "..%2F..%2Fetc%2Fpasswd", "%00", "a" * 3000])
def test_unknown_model_is_not_found(client: TestClient, name: str) -> None:
    for answer in (client.get(f"/v2/models/{name}"), client.post(f"/v2/models/{name}/infer", content=b"")):
        assert answer.status_code in (404, 405)


def test_failing_model_is_a_server_error(client: TestClient) -> None:
    out = io.BytesIO()
    Image.fromarray(image(FAILS)).save(out, "PNG")
    answer = client.post(INFER, content=out.getvalue(), headers={"Content-Type": "image/png"})
    assert answer.status_code == 500 and answer.json()["state"] == "failed"


def test_requests_without_the_token_are_rejected(engine: Engine, tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text("0123456789abcdef", encoding="utf-8")
    client = TestClient(application(engine, ServerParams(token=path)), base_url="http://localhost")
    for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "0123456789abcdef"}):
        assert client.post(INFER, content=jpeg(1), headers=headers).status_code == 401
    good = {"Authorization": "Bearer 0123456789abcdef", "Content-Type": "image/jpeg"}
    assert client.post(INFER, content=jpeg(1), headers=good).status_code == 200


def test_decompression_bomb_is_rejected_by_its_header(client: TestClient) -> None:
    out = io.BytesIO()
    Image.fromarray(np.zeros((20_000, 20_000), np.uint8)).save(out, "PNG")
    answer = client.post(INFER, content=out.getvalue(), headers={"Content-Type": "image/png"})
    assert answer.status_code == 422 and "pixels" in answer.json()["error"]
