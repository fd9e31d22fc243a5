"""Requests of the Open Inference Protocol as clients other than Triton's send them, to a running toolbox.

`python -m bench.foreign.cases.inference METHOD URL [FILE] [HEADER=VALUE ...]`, the command of a case, sends a request
and saves the response to `answer.json`; an error of the protocol is its error.
"""

from __future__ import annotations

import atexit
import base64
import io
import json
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.foreign.case import Case
from bench.waiting import until
from tests.fakes.ports import free_port

WIDTH, HEIGHT, START_S, DEADLINE_S = 64, 48, 200.0, 60
JSON_HEADER = "Content-Type=application/json"
Make = Callable[[Path], Sequence[object]]
_starting = threading.Lock()


def cases() -> Iterator[Case]:
    """Cases of kind 12."""
    photo = _photo()
    text, batch = _encoded(photo), photo[None]
    flat = photo.ravel().tolist()
    asked = {"outputs": [{"name": "results", "parameters": {"binary_data": False}}]}
    right: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
        "bytes": (_tensor([text], 1), {}),
        "bytes-nested": (_tensor([[text]], 1, 1), {}),
        "bytes-nested-flat-shape": (_tensor([[text]], 1), {}),
        "bytes-batch-shape": (_tensor([text], 1, 1), {}),
        "bytes-base64-parameter": (_tensor([text], 1) | {"parameters": {"content_type": "base64"}}, {}),
        "bytes-text-alone": (_tensor(text, 1), {}),
        "bytes-b64-object": (_tensor([{"b64": text}], 1), {}),
        "bytes-other-name": (_tensor([text], 1) | {"name": "input-0"}, {}),
        "pixels-flat": (_tensor(flat, *photo.shape, datatype="UINT8"), {}),
        "pixels-nested": (_tensor(photo.tolist(), *photo.shape, datatype="UINT8"), {}),
        "pixels-batch": (_tensor(flat, *batch.shape, datatype="UINT8"), {}),
        "pixels-batch-nested": (_tensor(batch.tolist(), *batch.shape, datatype="UINT8"), {}),
        "pixels-batch-nested-without": (_tensor(photo.tolist(), *batch.shape, datatype="UINT8"), {}),
        "outputs-asked": (_tensor([text], 1), asked),
        "id": (_tensor([text], 1), {"id": "r1"}),
        "id-empty": (_tensor([text], 1), {"id": ""}),
        "parameters": (_tensor([text], 1), {"parameters": {"content_type": "np", "priority": 1}}),
    }  # fmt: skip
    for name, (tensor, more) in right.items():
        yield _case(name, _post(tensor, more), check=_result_is(more))
    yield _case("version", _post(*right["bytes"], path="/versions/1/infer"), check=_result_is({}))
    yield _case("charset", _post(*right["bytes"], headers=(f"{JSON_HEADER}; charset=utf-8",)))
    for path in ("", "/ready", "/versions/1", "/versions/1/ready"):
        yield _case(f"get{path.replace('/', '-')}", _get(path))
    wrong: dict[str, tuple[dict[str, Any], str]] = {
        "channels-first": (_tensor([0] * 72, 1, 3, 6, 4, datatype="UINT8"), "422.*channels"),
        "floats": (_tensor([0.5] * 36, 1, 3, 4, 3, datatype="FP32"), "422.*FP32"),
        "ragged": (_tensor([[[1, 2, 3]], [[1, 2]]], 2, 1, 3, datatype="UINT8"), "422.*different lengths"),
        "other-shape": (_tensor(photo.transpose(1, 0, 2).tolist(), *photo.shape, datatype="UINT8"), "422.*shape"),
        "too-few": (_tensor([text], 2), "422.*1 values for shape"),
        "no-data": ({"name": "images", "datatype": "BYTES", "shape": [1]}, "422.*0 values"),
        "not-base64": (_tensor(["not base64!"], 1), "422.*base64"),
        "not-an-image": (_tensor([base64.b64encode(b"hello").decode()], 1), "422.*image"),
    }
    for name, (tensor, says) in wrong.items():
        yield _case(name, _post(tensor), "rejected", says)
    yield _case("other-version", _post(*right["bytes"], path="/versions/7/infer"), "rejected", "404.*version")
    yield _case("other-model", _get("", "other"), "rejected", "404.*model")
    yield _case("other-output", _post(_tensor([text], 1), {"outputs": [{"name": "boxes"}]}), "rejected", "422.*results")
    yield _case("other-content", _post({}, headers=("Content-Type=text/plain",)), "rejected", "415")
    yield _case("get-of-infer", _get("/infer"), "rejected", "405")


def _case(
    name: str, make: Make, expected: Any = "read", says: str = "", check: Callable[[Path], str] | None = None
) -> Case:
    return Case(f"inference-{name}", 12, make, expected, says, check or (lambda _: ""), module=__name__)


def _photo() -> Any:
    from PIL import Image

    from bench.paths import ROOT

    with Image.open(ROOT / "data_samples" / "tile" / "photos" / "0000_front.jpg") as image:
        return np.asarray(image.convert("RGB").resize((WIDTH, HEIGHT)))


def _encoded(photo: Any) -> str:
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(photo).save(out, "PNG")
    return base64.b64encode(out.getvalue()).decode()


def _tensor(data: Any, *shape: int, datatype: str = "BYTES") -> dict[str, Any]:
    return {"name": "images", "datatype": datatype, "shape": shape, "data": data}


def _post(
    tensor: Mapping[str, Any],
    more: Mapping[str, Any] | None = None,
    *,
    path: str = "/infer",
    headers: Sequence[str] = (JSON_HEADER,),
) -> Make:
    def make(folder: Path) -> Sequence[object]:
        file = folder / "request.json"
        file.write_text(json.dumps({"inputs": [tensor], **(more or {})}), encoding="utf-8")
        return ("POST", f"{_server()}/v2/models/detect{path}", file, *headers)

    return make


def _get(path: str, model: str = "detect") -> Make:
    return lambda _: ("GET", f"{_server()}/v2/models/{model}{path}")


def _server() -> str:
    """Address of the toolbox `detect`, which runs until this process ends."""
    with _starting:
        return _started()


@cache
def _started() -> str:
    port = free_port()
    command = [sys.executable, "-m", "scan2sim.flows.cli", "toolbox", "serve", "detect", "--port", str(port)]
    command += ["--set", f"deadline={DEADLINE_S}"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    atexit.register(process.kill)

    def is_ready() -> bool:
        assert process.poll() is None, "the toolbox has ended"
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/v2/health/ready", timeout=5):
                return True
        except OSError:
            return False

    until(is_ready, START_S, what="the toolbox")
    return f"http://127.0.0.1:{port}"


def _result_is(sent: Mapping[str, Any]) -> Callable[[Path], str]:
    """A check: the response has one result, for an image of the photo's size, and an id only where one was sent."""

    def check(folder: Path) -> str:
        answer = json.loads((folder / "answer.json").read_text(encoding="utf-8"))
        if answer.get("id") != sent.get("id"):
            return f"id {answer.get('id')!r} for {sent.get('id')!r}"
        (output,) = answer["outputs"]
        result = json.loads(output["data"][0])
        if output["shape"] != [1] or result["size"] != [WIDTH, HEIGHT] or result["state"] != "done":
            return f"another result: {output}"
        return ""

    return check


def main() -> None:
    """Run the command of a case."""
    method, url, *rest = sys.argv[1:]
    body = Path(rest[0]).read_bytes() if rest else None
    headers = dict(header.split("=", 1) for header in rest[1:])
    request = urllib.request.Request(url, body, headers, method=method)
    try:
        with urllib.request.urlopen(request, timeout=60) as response:
            Path("answer.json").write_bytes(response.read())
    except urllib.error.HTTPError as error:
        answer = json.loads(error.read())
        assert list(answer) == ["error"], answer
        print(f"error: {error.code}: {answer['error']}")
        sys.exit(1)


if __name__ == "__main__":
    main()
