"""Properties of one direction of an emulated link."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.step import Params


class LinkProfile(Params):
    """Rate, delay and loss of one direction; the defaults have no effect."""

    rate: Annotated[
        float | None, Field(ge=8000, le=1e10, description="Bits per second of Ethernet frames. Default: unlimited.")
    ] = None
    queue: Annotated[
        float, Field(gt=0, le=10, description="Length of the queue in seconds; packets beyond it are dropped.")
    ] = 0.1
    delay: Annotated[float, Field(ge=0, le=10, description="One-way delay in seconds.")] = 0.0
    jitter: Annotated[float, Field(ge=0, le=10, description="Maximum deviation of the delay in seconds.")] = 0.0
    loss: Annotated[float, Field(ge=0, lt=1, description="Share of packets that are lost.")] = 0.0
    burst: Annotated[
        float, Field(ge=1, le=1000, description="Mean number of packets lost in a row (Gilbert model); 1: independent.")
    ] = 1.0

    @property
    def backlog(self) -> int | None:
        """Maximum number of bytes in flight or in the queue; None: unlimited."""
        return None if self.rate is None else round(self.rate / 8 * (self.queue + self.delay + self.jitter))
