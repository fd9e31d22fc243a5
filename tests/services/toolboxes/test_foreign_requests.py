"""Requests as other clients of the Open Inference Protocol send them; errors as the protocol defines them."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="the extra toolboxes isn't installed")

from fastapi.testclient import TestClient

from scan2sim.services.toolboxes.inference.metadata import VERSION
from tests.services.toolboxes.shaky import image
from tests.services.toolboxes.test_api import INFER, TASK, client, engine, jpeg, level

__all__ = ["client", "engine"]

TEXT = base64.b64encode(jpeg(40)).decode()
PIXELS = image(40, (6, 4))
NESTED = PIXELS.tolist()


@pytest.mark.parametrize(
    "tensor",
    [
        {"datatype": "BYTES", "shape": [1], "data": [TEXT]},
        {"datatype": "BYTES", "shape": [1, 1], "data": [[TEXT]]},
        {"datatype": "BYTES", "shape": [1], "data": [[TEXT]]},
        {"datatype": "BYTES", "shape": [1, 1], "data": [TEXT]},
        {"datatype": "BYTES", "shape": [1], "data": [TEXT], "parameters": {"content_type": "base64"}},
        {"datatype": "BYTES", "shape": [1], "data": TEXT},
        {"datatype": "BYTES", "shape": [1], "data": [{"b64": TEXT}]},
        {"datatype": "UINT8", "shape": [*PIXELS.shape], "data": PIXELS.ravel().tolist()},
        {"datatype": "UINT8", "shape": [1, *PIXELS.shape], "data": PIXELS.ravel().tolist()},
        {"datatype": "UINT8", "shape": [1, *PIXELS.shape], "data": [NESTED]},
        {"datatype": "UINT8", "shape": [1, *PIXELS.shape], "data": NESTED},
        {"datatype": "UINT8", "shape": [*PIXELS.shape], "data": NESTED},
    ],
    ids=str,
)
@pytest.mark.parametrize("path", [INFER, INFER.replace("/infer", f"/versions/{VERSION}/infer")])
def test_every_form_of_an_image_is_accepted(client: TestClient, tensor: dict[str, Any], path: str) -> None:
    for more in ({}, {"outputs": [{"name": "results", "parameters": {"binary_data": False}}]}):
        answer = client.post(path, json={"inputs": [{"name": "images", **tensor}], **more})
        assert answer.status_code == 200, answer.text
        (output,) = answer.json()["outputs"]
        assert output["shape"] == [1] and abs(level(json.loads(output["data"][0])) - 40) <= 1


def test_two_images_nested_by_shape(client: TestClient) -> None:
    data = np.stack([image(10, (4, 4)), image(20, (4, 4))])
    tensor = {"name": "pixels", "datatype": "UINT8", "shape": [2, 4, 4, 3], "data": data.tolist()}
    (output,) = client.post(INFER, json={"inputs": [tensor]}).json()["outputs"]
    assert [level(json.loads(one)) for one in output["data"]] == [10, 20]


@pytest.mark.parametrize("sent", [{}, {"id": ""}, {"id": "r1"}])
def test_an_id_is_returned_only_where_one_was_sent(client: TestClient, sent: dict[str, str]) -> None:
    tensor = {"name": "images", "datatype": "BYTES", "shape": [1], "data": [TEXT]}
    answer = client.post(INFER, json={"inputs": [tensor], **sent}).json()
    assert {name: value for name, value in answer.items() if name == "id"} == sent


@pytest.mark.parametrize(
    ("tensor", "cause"),
    [
        ({"datatype": "UINT8", "shape": [6, 4, 3], "data": PIXELS.transpose(1, 0, 2).tolist()}, "[4, 6, 3]"),
        ({"datatype": "UINT8", "shape": [2, 1, 3], "data": [[[1, 2, 3]], [[1, 2]]]}, "different lengths"),
        ({"datatype": "UINT8", "shape": [1, 3, 6, 4], "data": [0] * 72}, "channels"),
        ({"datatype": "FP32", "shape": [1, 3, 6, 4], "data": [0.5] * 72}, "FP32"),
        ({"datatype": "BYTES", "shape": [1], "data": [{"url": "x"}]}, "base64"),
        ({"datatype": "BYTES", "shape": [2], "data": TEXT}, "1 values for shape [2]"),
        ({"datatype": "BYTES", "shape": [1]}, "0 values"),
    ],
)
def test_errors_are_those_of_the_protocol(client: TestClient, tensor: dict[str, Any], cause: str) -> None:
    answer = client.post(INFER, json={"inputs": [{"name": "images", **tensor}]})
    assert answer.status_code == 422 and list(answer.json()) == ["error"] and cause in answer.json()["error"]


def test_errors_of_paths_models_and_images_have_the_same_form(client: TestClient) -> None:
    no_image = {"name": "images", "datatype": "BYTES", "shape": [1], "data": [base64.b64encode(b"x").decode()]}
    answers = {
        404: client.get("/v2/models/other"),
        405: client.get(INFER),
        415: client.post(INFER, content=b"x", headers={"Content-Type": "text/plain"}),
        422: client.post(INFER, json={"inputs": [no_image]}),
    }
    assert "the format is unknown" in answers[422].json()["error"]
    for status, answer in answers.items():
        assert answer.status_code == status and list(answer.json()) == ["error"], answer.text
    assert client.get(f"/v2/models/{TASK}/versions/7").status_code == 404
    assert set(client.get("/nothing").json()) == {"where", "cause", "remedy", "error"}
