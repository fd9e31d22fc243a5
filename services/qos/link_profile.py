"""What a link does to packets of one direction."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.step import Params


class Shape(Params):
    """Rate, delay and losses; the defaults do nothing."""

    rate: Annotated[
        float | None, Field(ge=8000, le=1e10, description="Bits a second, of Ethernet frames; none: all that comes.")
    ] = None
    queue: Annotated[
        float, Field(gt=0, le=10, description="Seconds that packets wait for the rate, at most; more are dropped.")
    ] = 0.1
    delay: Annotated[float, Field(ge=0, le=10, description="Seconds on the way.")] = 0.0
    jitter: Annotated[float, Field(ge=0, le=10, description="Seconds that the delay is off by, at most.")] = 0.0
    loss: Annotated[float, Field(ge=0, lt=1, description="Share of the packets that is lost.")] = 0.0
    burst: Annotated[
        float, Field(ge=1, le=1000, description="Packets lost in a row, on average (Gilbert's model); 1: each alone.")
    ] = 1.0

    @property
    def backlog(self) -> int | None:
        """Bytes that may be on their way or wait; None: any."""
        return None if self.rate is None else round(self.rate / 8 * (self.queue + self.delay + self.jitter))
