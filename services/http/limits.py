"""Connection limits of the HTTP server: connections without a request are closed, and their number is bounded.

uvicorn's options don't do this: `timeout_keep_alive` begins with the first response, so a client that sends its header
slowly is never disconnected, and with `limit_concurrency` idle connections make it reject everyone's requests (503).
So this event loop puts a protocol of its own between asyncio and uvicorn, by documented interfaces of asyncio only.
"""

from __future__ import annotations

import asyncio
import contextlib
import resource
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

REQUEST_TIMEOUT_S = 10.0
"""A connection that sends no complete request header within this time is closed."""
MAX_CONNECTIONS = 4000
"""Open connections; further ones are closed immediately."""
SPARE_FILES = 200
"""File descriptors reserved for other purposes than connections."""


class LimitedEventLoop(asyncio.SelectorEventLoop):
    """Event loop whose servers limit their connections."""

    async def create_server(self, protocol_factory: Callable[[], Any], *args: Any, **options: Any) -> Any:
        """See `asyncio.loop.create_server`."""
        open_connections: set[_Connection] = set()
        if options.get("ssl"):
            options["ssl_handshake_timeout"] = REQUEST_TIMEOUT_S
        return await super().create_server(lambda: _Connection(protocol_factory(), open_connections), *args, **options)


@contextlib.contextmanager
def request_in_progress() -> Iterator[None]:
    """Stop the timeout of the connection whose request is handled in this context; afterwards it begins again."""
    connection = _connection.get()
    if connection is not None:
        connection.count_request(1)
    try:
        yield
    finally:
        if connection is not None:
            connection.count_request(-1)


class _Connection(asyncio.Protocol):
    """Passes everything to the server's protocol, and closes the connection if it sends no request in time.

    A WebSocket, which may be silent, is no longer limited: its protocol replaces this one.
    """

    def __init__(self, server: asyncio.Protocol, open_connections: set[_Connection]) -> None:
        self._server, self._open, self._requests = server, open_connections, 0
        self._timeout: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        self._transport = transport
        self._server.connection_made(transport)
        self._open.add(self)
        self.count_request(0)
        if len(self._open) > MAX_CONNECTIONS:
            transport.abort()

    def data_received(self, data: bytes) -> None:
        _connection.set(self)  # the task of a request inherits the context that it is created in
        self._server.data_received(data)
        self._forget_upgraded()

    def eof_received(self) -> bool | None:
        return self._server.eof_received()

    def connection_lost(self, error: Exception | None) -> None:
        self._forget()
        self._server.connection_lost(error)

    def pause_writing(self) -> None:
        self._server.pause_writing()

    def resume_writing(self) -> None:
        self._server.resume_writing()

    def count_request(self, change: int) -> None:
        """Update the number of requests in progress; the timeout begins when there are none."""
        self._requests += change
        if self._timeout is not None:
            self._timeout.cancel()
        if self._requests == 0 and self in self._open:
            self._timeout = asyncio.get_running_loop().call_later(REQUEST_TIMEOUT_S, self._close)

    def _close(self) -> None:
        self._forget_upgraded()
        if self in self._open:
            self._transport.close()

    def _forget_upgraded(self) -> None:
        if self._transport.get_protocol() is not self:
            self._forget()

    def _forget(self) -> None:
        self._open.discard(self)
        if self._timeout is not None:
            self._timeout.cancel()


_connection: ContextVar[_Connection | None] = ContextVar("connection", default=None)


def raise_file_limit() -> None:
    """Raise this process's limit of open files to what the connections need, as far as the hard limit permits."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = MAX_CONNECTIONS + SPARE_FILES
    limit = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    if soft != resource.RLIM_INFINITY and soft < limit:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
