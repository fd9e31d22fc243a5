"""Bodies of requests: received completely before a service handles the request, bounded in size, time and memory.

A client that sends its body slowly thus occupies nothing that others need. When too many bodies are arriving at once,
or they need too much memory, the one that has been arriving longest is given up.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, MutableMapping
from typing import Any

from fastapi import HTTPException
from starlette.requests import ClientDisconnect

BODY_TIMEOUT_S = 60.0
"""Time from a request's header to the end of its body."""
MAX_ARRIVING = 1000
"""Maximum number of bodies that are arriving."""
MAX_MEMORY_BODIES = 16
"""Memory for the bodies of all requests, as a multiple of the largest permitted body."""
RETRY_AFTER_S = 5
MAX_DISCARDED_BYTES, DISCARD_TIMEOUT_S = 64 * 2**20, 5.0
"""How much of a body that is too large is read and discarded, and for how long: a client that is still sending when the
connection is closed doesn't see the response."""

Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]


class _Body:
    """A body that is arriving."""

    size = 0

    def __init__(self, timeout: asyncio.Timeout) -> None:
        self.timeout = timeout


class Bodies:
    """Bodies of the requests of a service; used by one event loop."""

    def __init__(self, max_bytes: int) -> None:
        """`max_bytes`: limit of the size of a body."""
        self._max_bytes, self._max_total = max_bytes, MAX_MEMORY_BODIES * max_bytes
        self._arriving: dict[_Body, None] = {}
        self._total = 0

    @contextlib.asynccontextmanager
    async def receive(self, receive: Receive, headers: Mapping[bytes, bytes]) -> AsyncIterator[bytes]:
        """Receive the body of a request; its memory is accounted for until the context ends.

        Raises:
            HTTPException: it is too large (413), doesn't arrive in time (408), or memory is short (503).
            ClientDisconnect: the client has disconnected.
        """
        length = headers.get(b"content-length", b"0")
        if length.isdigit() and int(length) > self._max_bytes:
            await _discard(receive)
            raise self._too_large()
        if length == b"0" and b"transfer-encoding" not in headers:
            yield b""
            return
        body = _Body(asyncio.timeout(BODY_TIMEOUT_S))
        try:
            yield await self._receive(receive, body)
        finally:
            self._total -= body.size

    async def _receive(self, receive: Receive, body: _Body) -> bytes:
        data, complete = bytearray(), False
        try:
            async with body.timeout:
                self._arriving[body] = None
                while not complete:
                    message = await receive()
                    if message["type"] == "http.disconnect":
                        raise ClientDisconnect
                    data += message.get("body", b"")
                    complete = not message.get("more_body", False)
                    self._total += len(data) - body.size
                    body.size = len(data)
                    if body.size > self._max_bytes:
                        data.clear()
                        if not complete:
                            await _discard(receive)
                        raise self._too_large()
                    self._give_up_oldest(body)
        except TimeoutError:
            raise HTTPException(408, "the body didn't arrive in time") from None
        finally:
            self._arriving.pop(body, None)
        return bytes(data)

    def _give_up_oldest(self, body: _Body) -> None:
        """Give up the body that has been arriving longest if there are too many, or too little memory."""
        if self._total <= self._max_total and len(self._arriving) <= MAX_ARRIVING:
            return
        oldest = next((one for one in self._arriving if one is not body), None)
        if oldest is None:
            raise HTTPException(503, "too many large requests", {"Retry-After": str(RETRY_AFTER_S)})
        del self._arriving[oldest]
        oldest.timeout.reschedule(asyncio.get_running_loop().time())

    def _too_large(self) -> HTTPException:
        return HTTPException(413, f"the body is larger than {self._max_bytes} bytes")


async def _discard(receive: Receive) -> None:
    """Read the rest of a body within the bounds."""
    size = 0
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(DISCARD_TIMEOUT_S):
            while size < MAX_DISCARDED_BYTES:
                message = await receive()
                size += len(message.get("body", b""))
                if message["type"] == "http.disconnect" or not message.get("more_body", False):
                    return
