"""How records are kept for analysis, and asked for: what is told in code as on the command line."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from scan2sim.pipeline.core.step import Params
from scan2sim.services.kafka import Servers


def _seconds(given: Any) -> Any:
    """Seconds since the epoch, of these or of a date and time as 2026-11-22T15:30 (UTC where it says no zone)."""
    if not isinstance(given, str) or given.replace(".", "", 1).isdigit():
        return given
    when = datetime.fromisoformat(given)
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()


Time = Annotated[
    float,
    BeforeValidator(_seconds),
    Field(ge=0, le=1e11, json_schema_extra={"range": "a time as 2026-11-22T15:30, or seconds since 1970"}),
]


class ArchiveParams(Params):
    """Of who keeps records."""

    archive: Annotated[Path, Field(description="Folder for them; it is made if it isn't there.")]
    kafka_bootstrap_servers: Annotated[
        Servers, Field(description="Kafka with the records; it need not be there yet.")
    ] = "localhost:9092"
    topic: Annotated[str, Field(description="Kafka's topic of records.")] = "monitor_data"


class QueryParams(Params):
    """What is asked of an archive."""

    archive: Annotated[Path, Field(description="Folder that `monitor archive` keeps.")]
    begin: Annotated[Time | None, Field(description="From when on, as 2026-11-22T15:30 (UTC); default: all.")] = None
    end: Annotated[Time | None, Field(description="Until when.")] = None
    node: Annotated[str | None, Field(description="Of one node, as /site/camera.")] = None
    topic: Annotated[str | None, Field(description="Of one topic, as /camera/image.")] = None
    every: Annotated[float, Field(ge=1, le=10**7, description="Seconds that a line is of.")] = 60.0
