"""gRPC server of a toolbox: `inference.GRPCInferenceService`, as Triton publishes it (`triton/grpc_service.proto`).

It runs in a thread with an event loop of its own, and has the HTTP server's host, token and certificate. Its message
classes are created from the descriptors in `triton/grpc_service.binpb`, which protoc (package grpcio-tools) compiles
from the two proto files: `descriptor_set_out`, with `include_imports`.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hmac
import logging
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import grpc
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory

from scan2sim.pipeline.core.errors import ScanError, SettingError
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.inference import metadata, requests, tensors
from scan2sim.services.toolboxes.inference.metadata import Message
from scan2sim.services.toolboxes.results import State

log = logging.getLogger(__name__)

DESCRIPTORS = Path(__file__).parent / "triton" / "grpc_service.binpb"
SERVICE = "inference.GRPCInferenceService"
REQUEST_TIMEOUT_S = 60.0
"""Time for a request to arrive."""
STOP_TIMEOUT_S = 2.0
OPTIONS = [
    ("grpc.max_receive_message_length", tensors.MAX_REQUEST_BYTES),
    ("grpc.so_reuseport", 0),  # otherwise two servers may share a port
]
STATUS = {
    State.DROPPED: grpc.StatusCode.UNAVAILABLE,
    State.LATE: grpc.StatusCode.DEADLINE_EXCEEDED,
    State.REJECTED: grpc.StatusCode.INVALID_ARGUMENT,
    State.FAILED: grpc.StatusCode.INTERNAL,
}

Call = Callable[[Any, str], Awaitable[Message]]
"""Response to a request and the address of its client."""


class _CallError(Exception):
    """Error of a call; `status` is its status code."""

    def __init__(self, status: grpc.StatusCode, message: str) -> None:
        super().__init__(message)
        self.status = status


@contextlib.contextmanager
def serving(engine: Engine, params: ServerParams, port: int) -> Iterator[str]:
    """Serve a toolbox by gRPC while the context is active; returns the address, `HOST:PORT`.

    Args:
        engine: runs the toolbox.
        params: server settings; their port is the one of HTTP.
        port: port to listen on; 0: any free port.

    Raises:
        SettingError: it can't listen on the port.
        InputError: token or certificate are invalid.
    """
    params.check_tls()
    secret = params.secret()
    loop, stop, listening = asyncio.new_event_loop(), asyncio.Event(), Future[int]()

    async def serve() -> None:
        server = grpc.aio.server(interceptors=[_TokenCheck(secret)] if secret else [], options=OPTIONS)
        server.add_generic_rpc_handlers((_Service(engine).handler(),))
        try:
            bound = _listen(server, port, params)
            await server.start()
        except Exception as error:
            listening.set_exception(error)
            return
        listening.set_result(bound)
        await stop.wait()
        await server.stop(STOP_TIMEOUT_S)

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(),), name="gRPC server", daemon=True)
    thread.start()
    try:
        bound = listening.result()
    except RuntimeError as error:
        cause = f"can't listen on this port ({error})"
        raise SettingError("--grpc-port", cause, "Choose another port") from None
    try:
        yield f"{params.host}:{bound}"
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(2 * STOP_TIMEOUT_S)


def _listen(server: grpc.aio.Server, port: int, params: ServerParams) -> int:
    address = f"[{params.host}]:{port}" if ":" in params.host else f"{params.host}:{port}"
    if params.certificate is None or params.key is None:
        return server.add_insecure_port(address)
    pair = (params.key.read_bytes(), params.certificate.read_bytes())
    return server.add_secure_port(address, grpc.ssl_server_credentials([pair]))


class _TokenCheck(grpc.aio.ServerInterceptor):  # type: ignore[misc]
    """Rejects calls without the token before their message is received."""

    def __init__(self, secret: str) -> None:
        self._authorization = f"Bearer {secret}".encode()

    async def intercept_service(self, continuation: Callable[..., Awaitable[Any]], details: Any) -> Any:
        """See `grpc.aio.ServerInterceptor`."""
        sent = dict(details.invocation_metadata).get("authorization", "")
        if hmac.compare_digest(sent.encode(), self._authorization):
            return await continuation(details)

        async def reject(_: Any, context: grpc.aio.ServicerContext) -> None:
            message = "requires a token: send the metadata authorization: Bearer TOKEN"
            await context.abort(grpc.StatusCode.UNAUTHENTICATED, message)

        return grpc.stream_unary_rpc_method_handler(reject)


class _Service:
    """The calls of the service."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        files = descriptor_pb2.FileDescriptorSet.FromString(DESCRIPTORS.read_bytes())
        pool = descriptor_pool.DescriptorPool()  # not the default one: Triton's client has messages of the same names
        for file in files.file:
            pool.AddSerializedFile(file.SerializeToString())
        self._methods = {method.name: method for method in pool.FindServiceByName(SERVICE).methods}

    def handler(self) -> grpc.GenericRpcHandler:
        """Handler of all calls; those that toolboxes don't implement are answered with UNIMPLEMENTED."""
        calls = {
            "ServerLive": lambda _: {"live": self._engine.is_alive()},
            "ServerReady": lambda _: {"ready": self._engine.is_ready()},
            "ModelReady": self._of_model(lambda: {"ready": self._engine.is_ready()}),
            "ServerMetadata": lambda _: metadata.server(),
            "ModelMetadata": self._of_model(lambda: metadata.model(self._engine)),
            "ModelConfig": self._of_model(lambda: {"config": metadata.config(self._engine)}),
            "ModelStatistics": self._of_model(lambda: {"model_stats": [metadata.statistics(self._engine)]}),
            "RepositoryIndex": lambda _: {"models": metadata.index(self._engine)},
        }
        handlers = {name: self._handler(name, _awaitable(call)) for name, call in calls.items()}
        handlers["ModelInfer"] = self._handler("ModelInfer", self._infer)
        handlers["ModelStreamInfer"] = self._stream_handler()
        return grpc.method_handlers_generic_handler(SERVICE, handlers)

    def _handler(self, name: str, call: Call) -> grpc.RpcMethodHandler:
        """Handler of a call with one request, read as a stream so that its time to arrive can be limited."""
        request_class, response_class = self._messages(name)

        async def handle(received: AsyncIterator[Any], context: grpc.aio.ServicerContext) -> Any:
            try:
                request = await asyncio.wait_for(anext(received), REQUEST_TIMEOUT_S)
                return _filled(response_class(), await call(request, _client(context)))
            except (TimeoutError, StopAsyncIteration):
                await context.abort(grpc.StatusCode.DEADLINE_EXCEEDED, "the request didn't arrive in time")
            except Exception as error:
                await _abort(context, error)

        return grpc.stream_unary_rpc_method_handler(handle, request_class.FromString, response_class.SerializeToString)

    def _stream_handler(self) -> grpc.RpcMethodHandler:
        """Handler of the inference of a stream of requests, one after the other; errors don't end the stream."""
        request_class, response_class = self._messages("ModelStreamInfer")

        async def handle(received: AsyncIterator[Any], context: grpc.aio.ServicerContext) -> AsyncIterator[Any]:
            async for request in received:
                response = response_class()
                try:
                    _filled(response.infer_response, await self._infer(request, _client(context)))
                except (ScanError, _CallError, requests.TooManyRequests) as error:
                    response.error_message = str(error)
                    response.infer_response.id = request.id
                yield response

        return grpc.stream_stream_rpc_method_handler(handle, request_class.FromString, response_class.SerializeToString)

    def _messages(self, name: str) -> tuple[Any, Any]:
        """Classes of the request and the response of a call."""
        method = self._methods[name]
        return message_factory.GetMessageClass(method.input_type), message_factory.GetMessageClass(method.output_type)

    def _of_model(self, response: Callable[[], Message]) -> Callable[[Any], Message]:
        def call(request: Any) -> Message:
            self._check_model(request.name or self._engine.name, request.version)
            return response()

        return call

    def _check_model(self, name: str, version: str) -> None:
        if error := metadata.unknown_model(self._engine, name, version):
            raise _CallError(grpc.StatusCode.NOT_FOUND, error)

    async def _infer(self, request: Any, client: str) -> Message:
        self._check_model(request.model_name, request.model_version)
        tensors.check_outputs([one.name for one in request.outputs])
        parameters = {
            name: getattr(value, value.WhichOneof("parameter_choice") or "int64_param")
            for name, value in request.parameters.items()
        }
        images = await asyncio.to_thread(_images, request)
        source = str(parameters.get("source", requests.DEFAULT_SOURCE))[:200]
        timeout = requests.timeout_s(parameters)
        named = requests.named(request.id[:200], images)
        results = await requests.results(self._engine, client, source, named, timeout)
        if failed := [one for one in results if one.state in STATUS]:
            raise _CallError(STATUS[failed[0].state], f"{failed[0].id}: {failed[0].error}")
        return {
            "model_name": self._engine.name,
            "model_version": metadata.VERSION,
            "id": request.id,
            "outputs": [{"name": tensors.OUTPUT, "datatype": "BYTES", "shape": [len(results)]}],
            "raw_output_contents": [base64.b64encode(tensors.binary(results)).decode()],
        }


def _awaitable(call: Callable[[Any], Message]) -> Call:
    async def awaitable(request: Any, _: str) -> Message:
        return call(request)

    return awaitable


def _images(request: Any) -> list[tensors.Image]:
    """Images of a ModelInferRequest.

    Raises:
        ScanError: its tensors hold no valid images.
    """
    raw = request.raw_input_contents
    if not request.inputs or (raw and len(raw) != len(request.inputs)):
        cause = f"has {len(request.inputs)} tensors and {len(raw)} raw_input_contents"
        raise SettingError("inputs", cause, tensors.PROTOCOL)
    found: list[tensors.Image] = []
    for number, tensor in enumerate(request.inputs):
        contents = tensor.contents
        values = contents.bytes_contents if tensor.datatype == "BYTES" else contents.uint_contents
        binary = memoryview(raw[number]) if raw else None
        found += tensors.images(tensor.name[:200], tensor.datatype, list(tensor.shape), values, binary)
        tensors.check_count(len(found))
    return found


def _filled(message: Any, values: Message) -> Any:
    return json_format.ParseDict(values, message, ignore_unknown_fields=True)


def _client(context: grpc.aio.ServicerContext) -> str:
    """Address of a client without its port."""
    return str(context.peer()).rpartition(":")[0]


async def _abort(context: grpc.aio.ServicerContext, error: Exception) -> None:
    """End a call with the status of an error."""
    if isinstance(error, requests.TooManyRequests):
        trailer = (("retry-after", str(error.retry_after)),)
        await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, str(error), trailer)
    if isinstance(error, _CallError):
        await context.abort(error.status, str(error))
    if isinstance(error, ScanError):
        await context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))
    log.exception("%s: a call failed", SERVICE)
    await context.abort(grpc.StatusCode.INTERNAL, "internal error: see the service's log")
