"""Settings of the monitoring dashboard, for code and command line."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from scan2sim.services.http.settings import ServerParams
from scan2sim.services.kafka import ClientConfig, Servers
from scan2sim.services.monitoring.settings.limits import Limit, Limits


class PageParams(ServerParams):
    """Settings of the dashboard."""

    kafka_bootstrap_servers: Annotated[
        Servers, Field(description="Kafka servers with the records, HOST:PORT,...; retried until reachable.")
    ] = "localhost:9092"
    kafka_config: ClientConfig = None
    topic: Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,249}$", description="Kafka topic of records.")] = (
        "monitor_data"
    )
    events_topic: Annotated[
        str, Field(pattern=r"^[A-Za-z0-9._-]{1,249}$", description="Kafka topic of events: runs, queues and alarms.")
    ] = "bus_events"
    back: Annotated[
        float, Field(ge=0, le=604_800, description="Seconds of history before the start that are read from Kafka.")
    ] = 900.0
    limit: Limit = Limits()
