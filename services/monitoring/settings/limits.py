"""Limits of a node's traffic: values above them are red on the dashboard and warnings in records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from scan2sim.pipeline.core.step import Params
from scan2sim.services.monitoring.record import TopicFlow


class Limits(Params):
    """Upper limits; None: no limit."""

    bandwidth: Annotated[float, Field(ge=0, le=1e12, description="Bytes per second, in and out.")] | None = None
    latency: Annotated[float, Field(ge=0, le=86_400, description="Mean latency, seconds.")] | None = None
    lost: Annotated[float, Field(ge=0, le=1e9, description="Messages lost per period.")] | None = None
    messages: Annotated[float, Field(ge=0, le=1e9, description="Messages per period.")] | None = None
    size: Annotated[float, Field(ge=0, le=1e12, description="Mean message size, bytes.")] | None = None

    def exceeded(self, flows: Sequence[TopicFlow]) -> list[str]:
        """Warnings for the values that exceed their limit, each for one topic and direction."""
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
                    found.append(f"{flow.topic}: {flow.direction} {name} {value:.4g} exceeds the limit {limit:.4g}")
        return found


def _parse_assignments(value: Any) -> Any:
    """Convert a list of KEY=VALUE from the command line to a dict."""
    return dict(text.partition("=")[::2] for text in value or ()) if not isinstance(value, (dict, Limits)) else value


Limit = Annotated[
    Limits,
    BeforeValidator(_parse_assignments),
    Field(
        description="Upper limit of bandwidth (bytes/s), latency (s), lost or messages (per period), or size (bytes);"
        " may be repeated.",
        json_schema_extra={"range": f"KEY=VALUE, with KEY one of {', '.join(Limits.model_fields)}"},
    ),
]
