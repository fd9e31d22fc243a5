"""Settings of the record archive and of queries, for code and command line."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from scan2sim.pipeline.core.step import Params
from scan2sim.services.kafka import ClientConfig, Servers


def _parse_time(value: Any) -> Any:
    """Convert a date and time like 2026-11-22T15:30 (UTC without a zone) to seconds since the epoch; keep numbers."""
    if not isinstance(value, str) or value.replace(".", "", 1).isdigit():
        return value
    when = datetime.fromisoformat(value)
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()


Time = Annotated[
    float,
    BeforeValidator(_parse_time),
    Field(ge=0, le=1e11, json_schema_extra={"range": "a time like 2026-11-22T15:30, or seconds since 1970"}),
]


class ArchiveParams(Params):
    """Settings of the process that archives records."""

    archive: Annotated[Path, Field(description="Folder of the archive; created if missing.")]
    kafka_bootstrap_servers: Annotated[
        Servers, Field(description="Kafka servers with the records, HOST:PORT,...; retried until reachable.")
    ] = "localhost:9092"
    kafka_config: ClientConfig = None
    topic: Annotated[str, Field(description="Kafka topic of the records.")] = "monitor_data"


class QueryParams(Params):
    """Settings of a query of the archive."""

    archive: Annotated[Path, Field(description="Folder written by `monitor archive`.")]
    begin: Annotated[
        Time | None, Field(description="Start time, such as 2026-11-22T15:30 (UTC); default: the first record.")
    ] = None
    end: Annotated[Time | None, Field(description="End time, exclusive; default: the last record.")] = None
    node: Annotated[str | None, Field(description="Only this node, such as /site/camera; default: all.")] = None
    topic: Annotated[str | None, Field(description="Only this topic, such as /camera/image; default: all.")] = None
    every: Annotated[float, Field(ge=1, le=10**7, description="Length of the interval of a line, seconds.")] = 60.0
