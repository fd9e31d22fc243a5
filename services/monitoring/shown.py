"""What the live page shows, and where: what it is told in code as on the command line."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from scan2sim.pipeline.step import Params
from scan2sim.services.served import Served


class Limits(Params):
    """Values that are shown in red on the page where a node is beyond them; None: there is no limit."""

    bandwidth: Annotated[float, Field(ge=0, le=1e12, description="Bytes a second, in and out.")] | None = None
    latency: Annotated[float, Field(ge=0, le=86_400, description="Seconds.")] | None = None
    lost: Annotated[float, Field(ge=0, le=1e9, description="Messages lost in a period.")] | None = None
    messages: Annotated[float, Field(ge=0, le=1e9, description="Messages in a period.")] | None = None
    size: Annotated[float, Field(ge=0, le=1e12, description="Mean bytes of a message.")] | None = None


def _assigned(given: Any) -> Any:
    """Limits as they are given on the command line, KEY=VALUE each, by their names."""
    return dict(text.partition("=")[::2] for text in given or ()) if not isinstance(given, (dict, Limits)) else given


class PageParams(Served):
    """Of the live page."""

    kafka_bootstrap_servers: Annotated[
        str, Field(description="Kafka with the records, as host:port,host:port; it need not be there yet.")
    ] = "localhost:9092"
    topic: Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,249}$", description="Kafka's topic of records.")] = (
        "monitor_data"
    )
    back: Annotated[
        float, Field(ge=0, le=604_800, description="Seconds before its start from which the page shows records.")
    ] = 900.0
    limit: Annotated[
        Limits,
        BeforeValidator(_assigned),
        Field(
            description="Show values beyond it in red: bandwidth (bytes/s), latency (s), lost, messages, size (bytes).",
            json_schema_extra={"range": f"KEY=VALUE, with KEY one of {', '.join(Limits.model_fields)}"},
        ),
    ] = Limits()
