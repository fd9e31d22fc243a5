"""Connection limits of the HTTP server: idle connections are closed, and their number is bounded."""

from __future__ import annotations

import asyncio
import resource
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

FIRST_REQUEST_TIMEOUT_S = 10.0
"""A connection that sends no request within this time is closed."""
MAX_CONNECTIONS = 4000
"""Open connections; further ones are closed immediately."""
SPARE_FILES = 200
"""File descriptors reserved for other purposes than connections."""


class LimitedHttpProtocol(H11Protocol):
    """HTTP/1.1 protocol of uvicorn with a timeout for the first request and a limit of connections."""

    def connection_made(self, transport: Any) -> None:
        """Start the timeout for the first request."""
        super().connection_made(transport)
        if len(self.connections) > MAX_CONNECTIONS:
            transport.abort()
        else:
            self._timeout = self.loop.call_later(FIRST_REQUEST_TIMEOUT_S, self._close_if_idle)

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Cancel the timeout: a WebSocket may be silent."""
        self._cancel_timeout()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timeout."""
        self._cancel_timeout()
        super().connection_lost(exc)

    def _cancel_timeout(self) -> None:
        timeout: asyncio.TimerHandle | None = getattr(self, "_timeout", None)
        if timeout:
            timeout.cancel()

    def _close_if_idle(self) -> None:
        if self.cycle is None:
            self.transport.close()


def raise_file_limit() -> None:
    """Raise this process's limit of open files to what the connections need, as far as the hard limit permits."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = MAX_CONNECTIONS + SPARE_FILES
    limit = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    if soft != resource.RLIM_INFINITY and soft < limit:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
