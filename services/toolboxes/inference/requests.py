"""Inference requests of clients, over HTTP or gRPC: queued as a whole, awaited, cancelled if the client disconnects."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.inference.tensors import MAX_IMAGES, Image
from scan2sim.services.toolboxes.results import Result

DEFAULT_SOURCE = "http"
"""Source of images whose sender doesn't name one."""
MAX_WAITING_IMAGES = 2 * MAX_IMAGES
"""Images of one client address that may wait; requests beyond it are rejected with status 429."""
MAX_RETRY_AFTER_S = 60
MAX_TIMEOUT_S = 3600.0

Named = tuple[str, int | None, Image]
"""Id, time stamp and image."""


class TooManyRequests(Exception):
    """The client's queue is full.

    Attributes:
        retry_after: seconds after which there should be room.
    """

    def __init__(self, retry_after: int) -> None:
        super().__init__(f"{MAX_WAITING_IMAGES} images of this client may wait, and this request would exceed it")
        self.retry_after = retry_after


async def results(
    engine: Engine, client: str, source: str, images: Sequence[Named], timeout: float | None = None
) -> list[Result]:
    """Results of a request's images, in order; if cancelled, those that still wait are skipped.

    Args:
        engine: runs the toolbox.
        client: address of the client, whose requests share a queue.
        source: camera or stream of the images.
        images: at most `MAX_IMAGES`.
        timeout: seconds until the results are due; None: the toolbox's deadline, for each of the images.

    Raises:
        TooManyRequests: the client's queue is full.
    """
    loop, request = asyncio.get_running_loop(), object()
    futures: list[asyncio.Future[Result]] = [loop.create_future() for _ in images]

    def setter(future: asyncio.Future[Result]) -> Callable[[Result], None]:
        def set_result(result: Result) -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(_set, future, result)

        return set_result

    def is_wanted(future: asyncio.Future[Result]) -> Callable[[], bool]:
        return lambda: not future.cancelled()

    deadline = engine.deadline * len(images) if timeout is None else timeout
    made = [
        Frame(
            *(frame_id, source, stamp, image, setter(future)),
            queue=f"client {client}",
            request=request,
            deadline=deadline,
            is_wanted=is_wanted(future),
        )
        for (frame_id, stamp, image), future in zip(images, futures, strict=True)
    ]
    if not engine.submit_request(made, MAX_WAITING_IMAGES):
        raise TooManyRequests(min(MAX_RETRY_AFTER_S, math.ceil(engine.predicted_wait_s()) or 1))
    return await asyncio.gather(*futures)


def _set(future: asyncio.Future[Result], result: Result) -> None:
    if not future.done():  # it was cancelled if the client is gone
        future.set_result(result)


def named(request_id: str, images: Sequence[Image]) -> list[Named]:
    """Images with ids: that of the request, and their number in it."""
    return [(f"{request_id or 'image'}:{i}", None, image) for i, image in enumerate(images)]


def timeout_s(parameters: Mapping[str, Any]) -> float | None:
    """Timeout that a request's parameters set, in seconds; None: none.

    Raises:
        SettingError: it isn't a positive number of microseconds.
    """
    value = parameters.get("timeout")
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or not 0 < value <= MAX_TIMEOUT_S * 1e6:
        raise SettingError("timeout", "isn't a number of microseconds", f"At most {MAX_TIMEOUT_S * 1e6:.0f}")
    return value / 1e6
