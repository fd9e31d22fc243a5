"""Connections to what is served, within bounds: one that asks for nothing is closed, and keeps nobody out."""

from __future__ import annotations

import asyncio
import resource
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

SILENT = 10.0
"""Seconds from a connection's beginning within which it must have asked for something."""
MOST = 4000
"""Connections that are open at once; further ones are closed at once."""
SPARE = 200
"""Files that a service has open beside its connections."""


class Impatient(H11Protocol):
    """HTTP/1.1 as uvicorn speaks it, that waits for no one for ever."""

    def connection_made(self, transport: Any) -> None:
        """Begin to wait for a request."""
        super().connection_made(transport)
        if len(self.connections) > MOST:
            transport.abort()
        else:
            self._waiting = self.loop.call_later(SILENT, self._close_if_silent)

    def handle_websocket_upgrade(self, event: Any) -> None:
        """A WebSocket is asked for, which may be silent."""
        self._wait_no_more()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        self._wait_no_more()
        super().connection_lost(exc)

    def _wait_no_more(self) -> None:
        waiting: asyncio.TimerHandle | None = getattr(self, "_waiting", None)
        if waiting:
            waiting.cancel()

    def _close_if_silent(self) -> None:
        if self.cycle is None:
            self.transport.close()


def allow_many() -> None:
    """Have the system let this process open as many files as connections may need, if it does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST + SPARE if hard == resource.RLIM_INFINITY else min(MOST + SPARE, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
