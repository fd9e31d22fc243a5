"""HTTP API of a toolbox: the Open Inference Protocol (KServe, version 2), and endpoints to start and stop cameras.

Images are posted as files (`Content-Type: image/jpeg` etc.), or in the protocol's JSON: an input of datatype BYTES
holds encoded images in base64, one of UINT8 an RGB image of shape [height, width, 3]. The response to a file is a
result (`results.Result`), to JSON an output of datatype BYTES with one serialized result per image.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import FastAPI, Header, HTTPException, Request, Response
from fastapi.responses import JSONResponse
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from pydantic import BaseModel, Field, ValidationError

from scan2sim import __version__
from scan2sim.pipeline.core.errors import InputError, SettingError, printable
from scan2sim.pipeline.core.types import U8
from scan2sim.services.http import factory
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.toolboxes import frames
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Result, State
from scan2sim.services.toolboxes.sources import Cameras

MAX_REQUEST_BYTES = 2**25
"""Limit of the size of a request, equal to the number of pixels of the largest image."""
MAX_IMAGES = 64
"""Limit of images per request."""
IMAGE_TYPES = ("image/jpeg", "image/png", "image/webp", "application/octet-stream")
HTTP_STATUS = {State.DONE: 200, State.DROPPED: 503, State.LATE: 504, State.REFUSED: 422, State.FAILED: 500}
DEFAULT_SOURCE = "http"
"""Source of images whose sender doesn't name one."""

Text = Annotated[str, Field(max_length=200)]


class Tensor(BaseModel):
    """Input tensor of the protocol."""

    name: Text
    shape: Annotated[list[Annotated[int, Field(ge=1, le=MAX_REQUEST_BYTES)]], Field(min_length=1, max_length=4)]
    datatype: Literal["BYTES", "UINT8"]
    data: list[Any]


class InferRequest(BaseModel):
    """Inference request of the protocol; further fields are ignored."""

    id: Text = ""
    parameters: dict[str, Any] = {}
    inputs: Annotated[list[Tensor], Field(min_length=1, max_length=MAX_IMAGES)]


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
    def server() -> dict[str, Any]:
        """Server metadata of the protocol."""
        return {"name": "scan2sim", "version": __version__, "extensions": []}

    @app.get("/v2/health/live")
    def live() -> Response:
        """Liveness: whether the dispatcher is running."""
        return JSONResponse({"live": engine.is_alive()}, 200 if engine.is_alive() else 503)

    @app.get("/v2/health/ready")
    def ready() -> Response:
        """Readiness: whether the model is loaded and responds."""
        return JSONResponse({"ready": engine.is_ready()}, 200 if engine.is_ready() else 503)

    @app.get("/v2/models/{name}")
    def model(name: str) -> dict[str, Any]:
        """Model metadata of the protocol."""
        _check_model(engine, name)
        info = engine.info
        return {
            "name": engine.name,
            "versions": [info.sha256[:12]],
            "platform": info.name,
            "inputs": [{"name": "images", "datatype": "BYTES", "shape": [-1]}],
            "outputs": [{"name": "results", "datatype": "BYTES", "shape": [-1]}],
            "parameters": {"labels": info.labels, "sha256": info.sha256, "licence": info.licence},
        }

    @app.get("/v2/models/{name}/ready")
    def model_ready(name: str) -> Response:
        """Whether the model is loaded and responds."""
        _check_model(engine, name)
        return ready()


def _add_inference(app: FastAPI, engine: Engine) -> None:
    @app.post("/v2/models/{name}/infer")
    async def infer(
        name: str,
        request: Request,
        content_type: Annotated[str, Header()] = "",
        frame_id: Annotated[str, Header(max_length=200)] = "",
        source: Annotated[str, Header(max_length=200)] = DEFAULT_SOURCE,
        stamp: Annotated[int | None, Header(ge=0, lt=2**63)] = None,
    ) -> Response:
        """Run the model on images; a single image may have the headers `Frame-Id`, `Source` and `Stamp`."""
        _check_model(engine, name)
        media_type = content_type.partition(";")[0].strip().lower()
        body = await request.body()
        if media_type in IMAGE_TYPES:
            (result,) = await _results(engine, [(frame_id or "image", source, stamp, body)])
            return Response(result.json_line(), HTTP_STATUS[result.state], media_type="application/json")
        if media_type != "application/json":
            received = printable(media_type)[:40] or "missing"
            raise HTTPException(415, f"Content-Type is {received}; send JSON or {', '.join(IMAGE_TYPES)}")
        return await _infer_protocol(engine, body)

    async def _infer_protocol(engine: Engine, body: bytes) -> Response:
        try:
            infer_request = InferRequest.model_validate_json(body)
        except ValidationError as error:
            first = error.errors()[0]
            where = printable(".".join(map(str, first["loc"]))) or "body"
            raise SettingError(where[:200], first["msg"], "See the Open Inference Protocol, version 2") from None
        images = [image for tensor in infer_request.inputs for image in _images(tensor)]
        if len(images) > MAX_IMAGES:
            raise SettingError("inputs", f"contains {len(images)} images", f"Send at most {MAX_IMAGES}")
        source = str(infer_request.parameters.get("source", DEFAULT_SOURCE))[:200]
        name = infer_request.id or "image"
        results = await _results(engine, [(f"{name}:{i}", source, None, image) for i, image in enumerate(images)])
        worst = max(results, key=lambda one: HTTP_STATUS[one.state])
        output = {
            "name": "results",
            "datatype": "BYTES",
            "shape": [len(results)],
            "data": [one.json_line() for one in results],
        }
        response: dict[str, Any] = {"model_name": engine.name, "id": infer_request.id, "outputs": [output]}
        if worst.error:
            response["error"] = worst.error
        return JSONResponse(response, HTTP_STATUS[worst.state])


def _images(tensor: Tensor) -> list[bytes | U8]:
    """Images of an input tensor.

    Raises:
        InputError: the tensor holds no valid images.
    """
    remedy = "BYTES: base64 of encoded images, shape [N]; UINT8: RGB, shape [height, width, 3]"
    try:
        if tensor.datatype == "BYTES":
            found: list[bytes | U8] = [base64.b64decode(text, validate=True) for text in tensor.data]
            if len(found) != np.prod(tensor.shape):
                raise ValueError(f"{len(found)} values for shape {tensor.shape}")
            return found
        height, width, channels = tensor.shape
        frames.check_size(tensor.name, width, height)
        if channels != 3:
            raise ValueError(f"{channels} channels instead of 3")
        return [np.array(tensor.data, np.uint8).reshape(height, width, channels)]
    except (ValueError, TypeError, OverflowError, binascii.Error) as error:
        raise InputError(printable(tensor.name), f"not an image ({error})", remedy) from None


def _set(future: asyncio.Future[Result], result: Result) -> None:
    if not future.done():  # it was cancelled if the client is gone
        future.set_result(result)


async def _results(engine: Engine, images: list[tuple[str, str, int | None, bytes | U8]]) -> list[Result]:
    """Results of images, given with their ids, sources and stamps, in order."""
    loop = asyncio.get_running_loop()

    def setter(future: asyncio.Future[Result]) -> Callable[[Result], None]:
        def set_result(result: Result) -> None:
            loop.call_soon_threadsafe(_set, future, result)

        return set_result

    futures: list[asyncio.Future[Result]] = []
    for frame_id, source, stamp, image in images:
        futures.append(loop.create_future())
        engine.submit(Frame(frame_id, source, stamp, image, setter(futures[-1])))
    return await asyncio.gather(*futures)


def _check_model(engine: Engine, name: str) -> None:
    if name != engine.name:
        raise HTTPException(404, f"unknown model {printable(name)[:100]!r}; the model here is {engine.name!r}")


def _add_cameras(app: FastAPI, engine: Engine, cameras: Cameras) -> None:
    @app.get("/detections")
    def detections(source: str | None = None) -> list[dict[str, Any]]:
        """Latest result of each camera, or of one."""
        return [one.model_dump(mode="json", exclude_none=True) for one in cameras.last(source)]

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
        received = self._engine.counts["received"]
        waiting, oldest = self._engine.waiting()
        return [
            outcomes,
            CounterMetricFamily("scan2sim_frames_received", "Received frames", received),
            CounterMetricFamily("scan2sim_model_restarts", "Restarts of the model", self._engine.counts["restarts"]),
            GaugeMetricFamily("scan2sim_frames_waiting", "Waiting frames", waiting),
            GaugeMetricFamily("scan2sim_oldest_waiting_seconds", "Waiting time of the oldest frame", oldest),
            GaugeMetricFamily("scan2sim_batch_seconds", "Mean time of recent batches", self._engine.mean_batch_s()),
            GaugeMetricFamily("scan2sim_model_ready", "Whether the model responds", self._engine.is_ready()),
        ]
