"""Calls of a toolbox by Triton's client, run by the Python of `.venv-triton`; needs nothing of this project.

    python tests/fakes/triton_calls.py MODEL HTTP_ADDRESS GRPC_ADDRESS IMAGE...

prints a line of JSON: the number of calls, and the failed ones with their errors.
"""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tritonclient.grpc
import tritonclient.http
from tritonclient.utils import InferenceServerException

COUNTS = (1, 8, 64)
VERSION = "1"


def main() -> None:
    """Make all calls over both protocols."""
    model, http_address, grpc_address, *files = sys.argv[1:]
    encoded = [Path(file).read_bytes() for file in files]
    failed: dict[str, str] = {}
    calls = 0
    for name, module, address in (
        ("http", tritonclient.http, http_address),
        ("grpc", tritonclient.grpc, grpc_address),
    ):
        client = module.InferenceServerClient(address)
        for call, made in {**metadata(client, model), **inference(module, client, model, encoded)}.items():
            calls += 1
            try:
                made()
            except Exception as error:
                failed[f"{name} {call}"] = f"{type(error).__name__}: {error}"[:300]
    print(json.dumps({"calls": calls, "failed": failed}))


def metadata(client: Any, model: str) -> dict[str, Callable[[], None]]:
    """Health, metadata, configuration, index, statistics, errors."""

    def described(*version: str) -> None:
        found = client.get_model_metadata(model, *version)
        inputs = found["inputs"] if isinstance(found, dict) else [{"datatype": one.datatype} for one in found.inputs]
        check({one["datatype"] for one in inputs} == {"BYTES", "UINT8"})

    def configured(*version: str) -> None:
        found = client.get_model_config(model, *version)
        check((found["name"] if isinstance(found, dict) else found.config.name) == model)

    def refused(call: Callable[..., Any], *given: str) -> Callable[[], None]:
        def fails() -> None:
            try:
                call(*given)
            except InferenceServerException as error:
                check(bool(error.message()) and "None" not in error.message(), error)
            else:
                raise AssertionError("no error")

        return fails

    return {
        "live": lambda: check(client.is_server_live()),
        "ready": lambda: check(client.is_server_ready()),
        "model ready": lambda: check(client.is_model_ready(model)),
        "model ready, version": lambda: check(client.is_model_ready(model, VERSION)),
        "server metadata": lambda: check(bool(client.get_server_metadata())),
        "model metadata": described,
        "model metadata, version": lambda: described(VERSION),
        "config": configured,
        "config, version": lambda: configured(VERSION),
        "index": lambda: check(bool(client.get_model_repository_index())),
        "statistics": lambda: check(bool(client.get_inference_statistics())),
        "statistics of the model": lambda: check(bool(client.get_inference_statistics(model, VERSION))),
        "unknown model": refused(client.get_model_metadata, "other"),
        "unknown version": refused(client.get_model_metadata, model, "9"),
        "not offered": refused(client.load_model, model),
    }


def inference(module: Any, client: Any, model: str, encoded: list[bytes]) -> dict[str, Callable[[], None]]:
    """Inference of 1, 8, 64 images: encoded and raw, JSON and binary, with and without a version; asynchronous."""
    http = module is tritonclient.http
    calls: dict[str, Callable[[], None]] = {}

    def infer(inputs: Any, count: int, **options: Any) -> None:
        result = client.infer(model, [inputs], **options)
        results = result.as_numpy("results")
        check(results.shape == (count,), results.shape)
        check(all(json.loads(one)["state"] == "done" for one in results), results[:1])

    def tensor(name: str, values: Any, datatype: str, binary: bool) -> Any:
        made = module.InferInput(name, list(values.shape), datatype)
        made.set_data_from_numpy(values, **({"binary_data": binary} if http else {}))
        return made

    for count in COUNTS:
        images = [encoded[i % len(encoded)] for i in range(count)]
        pixels = np.full((count, 48, 64, 3), 100, np.uint8)
        for binary in (True, False) if http else (True,):
            texts = images if binary else [base64.b64encode(one) for one in images]
            for version in ("", VERSION):
                of_kind = f"{count} images, {'binary' if binary else 'JSON'}, version {version or 'none'}"
                given: dict[str, Any] = {"model_version": version, "request_id": "r1"}
                if http and not binary:
                    given["outputs"] = [module.InferRequestedOutput("results", binary_data=False)]
                for datatype, values in (("BYTES", np.array(texts, object)), ("UINT8", pixels)):
                    name = "images" if datatype == "BYTES" else "pixels"
                    made = tensor(name, values, datatype, binary)
                    calls[f"{datatype}, {of_kind}"] = partial(infer, made, count, **given)
    single = tensor("pixels", np.zeros((48, 64, 3), np.uint8), "UINT8", True)
    calls["one image without a batch axis"] = lambda: infer(single, 1)
    calls["requested output"] = lambda: infer(single, 1, outputs=[module.InferRequestedOutput("results")])
    calls["timeout and parameters"] = lambda: infer(single, 1, timeout=60_000_000, parameters={"source": "front"})
    if http:
        for kind in ("gzip", "deflate"):
            compressed = {"request_compression_algorithm": kind, "response_compression_algorithm": kind}
            calls[kind] = partial(infer, single, 1, **compressed)
        calls["asynchronous"] = lambda: check(
            client.async_infer(model, [single]).get_result().as_numpy("results").shape == (1,)
        )
    else:
        calls["asynchronous"] = lambda: _asynchronous(client, model, single)
        calls["stream"] = lambda: _stream(client, model, single)
    broken = tensor("images", np.array([b"no image"], object), "BYTES", True)
    calls["undecodable image"] = lambda: _refused(client, model, broken, "can't be decoded")
    odd = tensor("pixels", np.zeros((2, 2, 4), np.uint8), "UINT8", True)
    calls["four channels"] = lambda: _refused(client, model, odd, "4 channels")
    many = tensor("pixels", np.zeros((65, 2, 2, 3), np.uint8), "UINT8", True)
    calls["65 images"] = lambda: _refused(client, model, many, "65 images")
    floats = tensor("pixels", np.zeros((2, 2, 3), np.float32), "FP32", True)
    calls["floats"] = lambda: _refused(client, model, floats, "FP32")
    return calls


def _asynchronous(client: Any, model: str, image: Any) -> None:
    import queue

    came: queue.Queue[Any] = queue.Queue()
    client.async_infer(model, [image], lambda result, error: came.put((result, error)))
    result, error = came.get(timeout=60)
    check(error is None and result.as_numpy("results").shape == (1,), error)


def _stream(client: Any, model: str, image: Any) -> None:
    import queue

    came: queue.Queue[Any] = queue.Queue()
    client.start_stream(lambda result, error: came.put((result, error)))
    for name in (model, "other", model):
        client.async_stream_infer(name, [image])
    found = [came.get(timeout=60) for _ in range(3)]
    client.stop_stream()
    check([error is None for _, error in found] == [True, False, True], found)
    check("unknown model" in str(found[1][1]))


def _refused(client: Any, model: str, image: Any, cause: str) -> None:
    try:
        client.infer(model, [image])
    except InferenceServerException as error:
        check(cause in str(error), error)
    else:
        raise AssertionError("no error")


def check(condition: bool, found: object = "") -> None:
    """Raise an error with what was found unless a condition holds."""
    if not condition:
        raise AssertionError(str(found) or "false")


if __name__ == "__main__":
    main()
