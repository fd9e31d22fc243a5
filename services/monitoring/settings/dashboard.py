"""What the live page shows, and where: what it is told in code as on the command line."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from scan2sim.services.http.settings import Served
from scan2sim.services.kafka import Servers
from scan2sim.services.monitoring.settings.limits import Limit, Limits


class PageParams(Served):
    """Of the live page."""

    kafka_bootstrap_servers: Annotated[
        Servers, Field(description="Kafka with the records; it need not be there yet.")
    ] = "localhost:9092"
    topic: Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,249}$", description="Kafka's topic of records.")] = (
        "monitor_data"
    )
    events_topic: Annotated[
        str, Field(pattern=r"^[A-Za-z0-9._-]{1,249}$", description="Kafka's topic of events: runs and alarms.")
    ] = "bus_events"
    back: Annotated[
        float, Field(ge=0, le=604_800, description="Seconds before its start from which the page shows records.")
    ] = 900.0
    limit: Limit = Limits()
