"""Limits of what goes through a node: on the page in red, in records as remarks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from scan2sim.pipeline.core.step import Params
from scan2sim.services.monitoring.node.record import TopicFlow


class Limits(Params):
    """Values that are not to be exceeded; None: there is no limit."""

    bandwidth: Annotated[float, Field(ge=0, le=1e12, description="Bytes a second, in and out.")] | None = None
    latency: Annotated[float, Field(ge=0, le=86_400, description="Seconds.")] | None = None
    lost: Annotated[float, Field(ge=0, le=1e9, description="Messages lost in a period.")] | None = None
    messages: Annotated[float, Field(ge=0, le=1e9, description="Messages in a period.")] | None = None
    size: Annotated[float, Field(ge=0, le=1e12, description="Mean bytes of a message.")] | None = None

    def exceeded(self, flows: Sequence[TopicFlow]) -> list[str]:
        """What is over its limit, of one topic and direction each, in words."""
        found = []
        for flow in flows:
            values = {
                "bandwidth": flow.bandwidth,
                "latency": None if flow.latency is None else flow.latency / 1e9,
                "lost": flow.lost,
                "messages": flow.messages,
                "size": flow.size,
            }
            for name, limit in self.model_dump(exclude_none=True).items():
                value = values[name]
                if value is not None and value > limit:
                    found.append(f"{flow.topic}: {flow.direction} {name} {value:.4g} is over its limit, {limit:.4g}")
        return found


def _assigned(given: Any) -> Any:
    """Limits as they are given on the command line, KEY=VALUE each, by their names."""
    return dict(text.partition("=")[::2] for text in given or ()) if not isinstance(given, (dict, Limits)) else given


Limit = Annotated[
    Limits,
    BeforeValidator(_assigned),
    Field(
        description="Limits: bandwidth (bytes/s), latency (s), lost, messages, size (bytes); may be repeated.",
        json_schema_extra={"range": f"KEY=VALUE, with KEY one of {', '.join(Limits.model_fields)}"},
    ),
]
