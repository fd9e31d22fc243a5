"""A toolbox by HTTP: the paths of the Open Inference Protocol (KServe, version 2), and what starts and stops it.

Images are sent as they are (`Content-Type: image/jpeg` and the like), or in the protocol's JSON: an input of the
datatype BYTES holds encoded images in base64, one of UINT8 an RGB image of the shape [height, width, 3]. The answer to
the one is a result (`results.Result`), to the other an output of BYTES with a result a string.
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
from scan2sim.services.http.settings import Served
from scan2sim.services.toolboxes import frames
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Result, State
from scan2sim.services.toolboxes.sources import Cameras

LARGEST = 2**25
"""Bytes of a request: as many as the pixels of the largest image."""
IMAGES = 64
"""Of a request, at most."""
ENCODED = ("image/jpeg", "image/png", "image/webp", "application/octet-stream")
STATUS = {State.DONE: 200, State.DROPPED: 503, State.LATE: 504, State.REFUSED: 422, State.FAILED: 500}
UNNAMED = "http"
"""Source of images whose sender names none."""

Text = Annotated[str, Field(max_length=200)]


class Tensor(BaseModel):
    """An input, as the protocol says."""

    name: Text
    shape: Annotated[list[Annotated[int, Field(ge=1, le=LARGEST)]], Field(min_length=1, max_length=4)]
    datatype: Literal["BYTES", "UINT8"]
    data: list[Any]


class Asked(BaseModel):
    """A request, as the protocol says; what else it may say is left."""

    id: Text = ""
    parameters: dict[str, Any] = {}
    inputs: Annotated[list[Tensor], Field(min_length=1, max_length=IMAGES)]


def application(engine: Engine, served: Served, cameras: Cameras | None = None) -> FastAPI:
    """A toolbox's interface.

    Args:
        engine: of the toolbox.
        served: how it listens.
        cameras: whose images it reads by itself.

    Raises:
        InputError: the token can't be read.
    """
    app = factory.application(
        f"scan2sim toolbox {engine.name}",
        served,
        alive={"dispatcher": engine.is_alive},
        ready={"model": engine.is_ready},
        largest=LARGEST,
    )
    app.state.registry.register(_Figures(engine))
    _describe(app, engine)
    _infer(app, engine)
    if cameras:
        _watch(app, engine, cameras)
    return app


def _describe(app: FastAPI, engine: Engine) -> None:
    @app.get("/v2")
    def server() -> dict[str, Any]:
        """The server, as the protocol says."""
        return {"name": "scan2sim", "version": __version__, "extensions": []}

    @app.get("/v2/health/live")
    def live() -> Response:
        """Whether it lives."""
        return JSONResponse({"live": engine.is_alive()}, 200 if engine.is_alive() else 503)

    @app.get("/v2/health/ready")
    def ready() -> Response:
        """Whether its model answers."""
        return JSONResponse({"ready": engine.is_ready()}, 200 if engine.is_ready() else 503)

    @app.get("/v2/models/{name}")
    def model(name: str) -> dict[str, Any]:
        """What is known of the model."""
        _own(engine, name)
        facts = engine.facts
        return {
            "name": engine.name,
            "versions": [facts.sha256[:12]],
            "platform": facts.name,
            "inputs": [{"name": "images", "datatype": "BYTES", "shape": [-1]}],
            "outputs": [{"name": "results", "datatype": "BYTES", "shape": [-1]}],
            "parameters": {"labels": facts.labels, "sha256": facts.sha256, "licence": facts.licence},
        }

    @app.get("/v2/models/{name}/ready")
    def model_ready(name: str) -> Response:
        """Whether the model answers."""
        _own(engine, name)
        return ready()


def _infer(app: FastAPI, engine: Engine) -> None:
    @app.post("/v2/models/{name}/infer")
    async def infer(
        name: str,
        request: Request,
        content_type: Annotated[str, Header()] = "",
        frame_id: Annotated[str, Header(max_length=200)] = "",
        source: Annotated[str, Header(max_length=200)] = UNNAMED,
        stamp: Annotated[int | None, Header(ge=0, lt=2**63)] = None,
    ) -> Response:
        """What the model says of images; an image alone may bring its `Frame-Id`, `Source` and `Stamp` as headers."""
        _own(engine, name)
        kind = content_type.partition(";")[0].strip().lower()
        body = await request.body()
        if kind in ENCODED:
            (result,) = await _results(engine, [(frame_id or "image", source, stamp, body)])
            return Response(result.json_line(), STATUS[result.state], media_type="application/json")
        if kind != "application/json":
            raise HTTPException(415, f"is {printable(kind)[:40] or 'of no type'}; send JSON or {', '.join(ENCODED)}")
        return await _protocol(engine, body)

    async def _protocol(engine: Engine, body: bytes) -> Response:
        try:
            asked = Asked.model_validate_json(body)
        except ValidationError as error:
            first = error.errors()[0]
            where = printable(".".join(map(str, first["loc"]))) or "body"
            raise SettingError(where[:200], first["msg"], "See the Open Inference Protocol") from None
        images = [image for tensor in asked.inputs for image in _images(tensor)]
        if len(images) > IMAGES:
            raise SettingError("inputs", f"hold {len(images)} images", f"Send {IMAGES} at most")
        source, name = str(asked.parameters.get("source", UNNAMED))[:200], asked.id or "image"
        results = await _results(engine, [(f"{name}:{i}", source, None, image) for i, image in enumerate(images)])
        worst = max(results, key=lambda one: STATUS[one.state])
        output = {
            "name": "results",
            "datatype": "BYTES",
            "shape": [len(results)],
            "data": [one.json_line() for one in results],
        }
        answer: dict[str, Any] = {"model_name": engine.name, "id": asked.id, "outputs": [output]}
        if worst.error:
            answer["error"] = worst.error
        return JSONResponse(answer, STATUS[worst.state])


def _images(tensor: Tensor) -> list[bytes | U8]:
    """Of an input.

    Raises:
        InputError: it holds something else.
    """
    remedy = "BYTES: base64 of encoded images, shape [N]; UINT8: RGB, shape [height, width, 3]"
    try:
        if tensor.datatype == "BYTES":
            found: list[bytes | U8] = [base64.b64decode(text, validate=True) for text in tensor.data]
            if len(found) != np.prod(tensor.shape):
                raise ValueError(f"{len(found)} values for the shape {tensor.shape}")
            return found
        height, width, channels = tensor.shape
        frames.check_size(tensor.name, width, height)
        if channels != 3:
            raise ValueError("three channels are wanted")
        return [np.array(tensor.data, np.uint8).reshape(height, width, channels)]
    except (ValueError, TypeError, OverflowError, binascii.Error) as error:
        raise InputError(printable(tensor.name), f"is no image ({error})", remedy) from None


def _set(future: asyncio.Future[Result], result: Result) -> None:
    if not future.done():  # who asked may be gone
        future.set_result(result)


async def _results(engine: Engine, images: list[tuple[str, str, int | None, bytes | U8]]) -> list[Result]:
    """Of images with their ids, sources and stamps, in order."""
    loop = asyncio.get_running_loop()

    def answered(future: asyncio.Future[Result]) -> Callable[[Result], None]:
        def answer(result: Result) -> None:
            loop.call_soon_threadsafe(_set, future, result)

        return answer

    futures: list[asyncio.Future[Result]] = []
    for frame_id, source, stamp, image in images:
        futures.append(loop.create_future())
        engine.submit(Frame(frame_id, source, stamp, image, answered(futures[-1])))
    return await asyncio.gather(*futures)


def _own(engine: Engine, name: str) -> None:
    if name != engine.name:
        raise HTTPException(404, f"there is no model {printable(name)[:100]!r}, but {engine.name!r}")


def _watch(app: FastAPI, engine: Engine, cameras: Cameras) -> None:
    @app.get("/detections")
    def detections(source: str | None = None) -> list[dict[str, Any]]:
        """The last result of each camera, or of one."""
        return [one.model_dump(mode="json", exclude_none=True) for one in cameras.last(source)]

    @app.post("/start")
    def start() -> dict[str, Any]:
        """Read the cameras' images, from now on."""
        cameras.start()
        return status()

    @app.post("/stop")
    def stop() -> dict[str, Any]:
        """Standby: no image is read, the model stays loaded."""
        cameras.stop()
        return status()

    @app.get("/status")
    def status() -> dict[str, Any]:
        """Whether it looks, and how its cameras and its model are."""
        return {"running": cameras.running(), "ready": engine.is_ready(), "cameras": cameras.states()}


class _Figures:
    """What Prometheus is told of an engine."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def collect(self) -> list[Metric]:
        """Its figures, now."""
        outcomes = CounterMetricFamily("scan2sim_frames", "Frames, by what became of them", labels=["state"])
        for state in State:
            outcomes.add_metric([state], self._engine.counts[state])
        received = self._engine.counts["received"]
        waiting, oldest = self._engine.waiting()
        return [
            outcomes,
            CounterMetricFamily("scan2sim_frames_received", "Frames that came", received),
            CounterMetricFamily("scan2sim_model_restarts", "Restarts of the model", self._engine.counts["restarts"]),
            GaugeMetricFamily("scan2sim_frames_waiting", "Frames that wait", waiting),
            GaugeMetricFamily("scan2sim_oldest_waiting_seconds", "Age of the frame that waits longest", oldest),
            GaugeMetricFamily("scan2sim_batch_seconds", "Time that a batch takes, lately", self._engine.typical()),
            GaugeMetricFamily("scan2sim_model_ready", "Whether the model answers", self._engine.is_ready()),
        ]
