"""HTTP API of a toolbox: the Open Inference Protocol (KServe, version 2), and endpoints to start and stop cameras.

Images are posted as files (`Content-Type: image/jpeg` etc.), or in the protocol's JSON, with or without binary tensor
data (`inference.tensors`). The response to a file is a result (`results.Result`), to the protocol an output of datatype
BYTES with one serialized result per image.
"""

from __future__ import annotations

import asyncio
import json
import zlib
from collections.abc import Coroutine, Sequence
from typing import Annotated, Any, TypeVar

from fastapi import Depends, FastAPI, Header, HTTPException, Request, Response
from fastapi.responses import JSONResponse
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from starlette.requests import ClientDisconnect

from scan2sim.pipeline.core.errors import SettingError, printable
from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.inference import metadata, requests, tensors
from scan2sim.services.toolboxes.inference.tensors import MAX_REQUEST_BYTES
from scan2sim.services.toolboxes.results import Result, State
from scan2sim.services.toolboxes.sources import Cameras

IMAGE_TYPES = ("image/jpeg", "image/png", "image/webp", "application/octet-stream")
JSON = "application/json"
JSON_SIZE_HEADER = "Inference-Header-Content-Length"
"""Header with the size of the JSON in a body that has binary tensor data behind it."""
HTTP_STATUS = {State.DONE: 200, State.DROPPED: 503, State.LATE: 504, State.REJECTED: 422, State.FAILED: 500}

T = TypeVar("T")


def application(engine: Engine, params: ServerParams, cameras: Cameras | None = None) -> FastAPI:
    """Create the web application of a toolbox.

    Args:
        engine: runs the toolbox.
        params: server settings.
        cameras: cameras that the toolbox reads itself.

    Raises:
        InputError: the token can't be read.
    """
    app = factory.application(
        f"scan2sim toolbox {engine.name}",
        params,
        alive={"dispatcher": engine.is_alive},
        ready={"model": engine.is_ready},
        health=("/v2/health/",),
        max_body_bytes=MAX_REQUEST_BYTES,
    )
    app.state.registry.register(_EngineMetrics(engine))
    _add_metadata(app, engine)
    _add_inference(app, engine)
    if cameras:
        _add_cameras(app, engine, cameras)
    return app


def _add_metadata(app: FastAPI, engine: Engine) -> None:
    @app.get("/v2")
    @app.get("/v2/", include_in_schema=False)
    async def server() -> dict[str, Any]:
        """Server metadata of the protocol."""
        return metadata.server()

    @app.get("/v2/health/live")
    async def live() -> Response:
        """Liveness: whether the dispatcher is running."""
        return JSONResponse({"live": engine.is_alive()}, 200 if engine.is_alive() else 503)

    @app.get("/v2/health/ready")
    async def ready() -> Response:
        """Readiness: whether the model is loaded and responds."""
        return JSONResponse({"ready": engine.is_ready()}, 200 if engine.is_ready() else 503)

    @app.get("/v2/models/stats")
    async def all_statistics() -> dict[str, Any]:
        """Statistics of all models, which is one (Triton's extension)."""
        return {"model_stats": [metadata.statistics(engine)]}

    for path, known in _model_paths(engine):

        @app.get(path, dependencies=known)
        async def model() -> dict[str, Any]:
            """Model metadata of the protocol."""
            return metadata.model(engine)

        @app.get(f"{path}/ready", dependencies=known)
        async def model_ready() -> Response:
            """Whether the model is loaded and responds."""
            return await ready()

        @app.get(f"{path}/config", dependencies=known)
        async def config() -> dict[str, Any]:
            """Model configuration (Triton's extension)."""
            return metadata.config(engine)

        @app.get(f"{path}/stats", dependencies=known)
        async def statistics() -> dict[str, Any]:
            """Statistics of the model (Triton's extension)."""
            return {"model_stats": [metadata.statistics(engine)]}

    @app.post("/v2/repository/index")
    async def index() -> list[dict[str, Any]]:
        """Index of the models, which is one (Triton's extension)."""
        return metadata.index(engine)


def _model_paths(engine: Engine) -> list[tuple[str, Sequence[Any]]]:
    """Paths of the model without and with a version, each with the check that it is the toolbox's model."""

    def check(name: str, version: str = "") -> None:
        if error := metadata.unknown_model(engine, name, version):
            raise HTTPException(404, error)

    def known_model(name: str) -> None:
        check(name)

    def known_version(name: str, version: str) -> None:
        check(name, version)

    path = "/v2/models/{name}"
    return [(path, [Depends(known_model)]), (f"{path}/versions/{{version}}", [Depends(known_version)])]


def _add_inference(app: FastAPI, engine: Engine) -> None:
    parsing = asyncio.Semaphore(1)  # JSON is parsed without releasing the interpreter to other requests

    async def infer(
        request: Request,
        content_type: Annotated[str, Header()] = "",
        content_encoding: Annotated[str, Header(max_length=20)] = "identity",
        inference_header_content_length: Annotated[int | None, Header(ge=1)] = None,
        frame_id: Annotated[str, Header(max_length=200)] = "",
        source: Annotated[str, Header(max_length=200)] = requests.DEFAULT_SOURCE,
        stamp: Annotated[int | None, Header(ge=0, lt=2**63)] = None,
    ) -> Response:
        """Run the model on images; a single image may have the headers `Frame-Id`, `Source` and `Stamp`."""
        body = _decompressed(await request.body(), content_encoding)
        media_type = content_type.partition(";")[0].strip().lower()
        json_bytes = inference_header_content_length
        is_protocol = json_bytes is not None or media_type == JSON or (not media_type and body[:1] in (b"{", b""))
        if is_protocol:
            async with parsing:
                parsed, images = await asyncio.to_thread(tensors.parse, body, json_bytes)
            source = str(parsed.parameters.get("source", source))[:200]
            timeout = requests.timeout_s(parsed.parameters)
            return _protocol_response(
                engine, parsed, await results(request, source, requests.named(parsed.id or "", images), timeout)
            )
        if media_type and media_type not in IMAGE_TYPES:
            cause = f"Content-Type is {printable(media_type)[:40]}; send JSON or {', '.join(IMAGE_TYPES)}"
            raise HTTPException(415, cause)
        (result,) = await results(request, source, [(frame_id or "image", stamp, body)], None)
        return Response(result.json_line(), HTTP_STATUS[result.state], media_type=JSON)

    async def results(
        request: Request, source: str, images: list[requests.Named], timeout: float | None
    ) -> list[Result]:
        client = request.client.host if request.client else "unknown"
        try:
            return await _while_connected(request, requests.results(engine, client, source, images, timeout))
        except requests.TooManyRequests as error:
            raise HTTPException(429, str(error), {"Retry-After": str(error.retry_after)}) from None

    for path, known in _model_paths(engine):
        app.post(f"{path}/infer", dependencies=known)(infer)


def _protocol_response(engine: Engine, request: tensors.InferRequest, results: list[Result]) -> Response:
    worst = max(results, key=lambda one: HTTP_STATUS[one.state])
    status = HTTP_STATUS[worst.state]
    if worst.error:
        return JSONResponse({"error": f"{worst.id}: {worst.error}"}, status)
    output: dict[str, Any] = {"name": tensors.OUTPUT, "datatype": "BYTES", "shape": [len(results)]}
    message: dict[str, Any] = {"model_name": engine.name, "model_version": metadata.VERSION, "outputs": [output]}
    if request.id is not None:
        message["id"] = request.id
    if not request.wants_binary():
        output["data"] = [one.json_line() for one in results]
        return JSONResponse(message, status)
    data = tensors.binary(results)
    output["parameters"] = {"binary_data_size": len(data)}
    text = json.dumps(message).encode()
    return Response(text + data, status, {JSON_SIZE_HEADER: str(len(text))}, media_type="application/octet-stream")


def _decompressed(body: bytes, encoding: str) -> bytes:
    """Body of a request without its Content-Encoding; decompression bombs are rejected.

    Raises:
        HTTPException: unknown encoding.
        SettingError: the body is damaged or too large.
    """
    if encoding in ("", "identity"):
        return body
    if encoding not in ("gzip", "deflate"):
        raise HTTPException(415, f"Content-Encoding is {printable(encoding)}; send gzip, deflate or identity")
    decompressor = zlib.decompressobj(zlib.MAX_WBITS + (16 if encoding == "gzip" else 0))
    try:
        decoded = decompressor.decompress(body, MAX_REQUEST_BYTES)
    except zlib.error as error:
        raise SettingError("body", f"can't be decompressed ({error})", f"Send valid {encoding}") from None
    if not decompressor.eof:
        cause = f"is incomplete or has more than {MAX_REQUEST_BYTES} bytes when decompressed"
        raise SettingError("body", cause, "Send fewer images")
    return decoded


async def _while_connected(request: Request, work: Coroutine[Any, Any, T]) -> T:
    """Result of a coroutine, which is cancelled if the client disconnects.

    Raises:
        ClientDisconnect: the client has disconnected.
    """

    async def disconnected() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass

    task, connection = asyncio.ensure_future(work), asyncio.ensure_future(disconnected())
    try:
        await asyncio.wait((task, connection), return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            raise ClientDisconnect
        return task.result()
    finally:
        task.cancel()
        connection.cancel()


def _add_cameras(app: FastAPI, engine: Engine, cameras: Cameras) -> None:
    @app.get("/detections")
    def detections(source: str | None = None) -> list[dict[str, Any]]:
        """Latest result of each camera, or of one."""
        return [one.model_dump(mode="json", by_alias=True, exclude_none=True) for one in cameras.last(source)]

    @app.post("/start")
    def start() -> dict[str, Any]:
        """Start reading the cameras."""
        cameras.start()
        return status()

    @app.post("/stop")
    def stop() -> dict[str, Any]:
        """Standby: stop reading the cameras; the model stays loaded."""
        cameras.stop()
        return status()

    @app.get("/status")
    def status() -> dict[str, Any]:
        """Whether the cameras are being read, and the state of the cameras and the model."""
        return {"running": cameras.running(), "ready": engine.is_ready(), "cameras": cameras.states()}


class _EngineMetrics:
    """Metrics of an engine for Prometheus."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def collect(self) -> list[Metric]:
        """Current values of the metrics."""
        outcomes = CounterMetricFamily("scan2sim_frames", "Frames by final state", labels=["state"])
        for state in State:
            outcomes.add_metric([state], self._engine.counts[state])
        received, beyond_queue = self._engine.counts["received"], self._engine.counts["beyond_queue"]
        waiting, oldest = self._engine.waiting()
        return [
            outcomes,
            CounterMetricFamily("scan2sim_frames_received", "Received frames", received),
            CounterMetricFamily("scan2sim_frames_rejected", "Frames beyond a client's queue", beyond_queue),
            CounterMetricFamily("scan2sim_model_restarts", "Restarts of the model", self._engine.counts["restarts"]),
            GaugeMetricFamily("scan2sim_frames_waiting", "Waiting frames", waiting),
            GaugeMetricFamily("scan2sim_oldest_waiting_seconds", "Waiting time of the oldest frame", oldest),
            GaugeMetricFamily("scan2sim_batch_seconds", "Mean time of recent batches", self._engine.mean_batch_s()),
            GaugeMetricFamily("scan2sim_model_ready", "Whether the model responds", self._engine.is_ready()),
        ]
