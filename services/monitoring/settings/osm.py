"""Settings of the autoscaler of functions in OSM, for code and command line."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from scan2sim.services.monitoring.settings.bus import WorkerPoolParams
from scan2sim.services.orchestration.settings import Connection


class AutoscaleParams(WorkerPoolParams, Connection):
    """Settings of the node that scales an instance according to queue load."""

    instance: Annotated[str, Field(max_length=200, description="Name of the instance in OSM.")]
