"""Default settings of Prefect for these flows; must be imported before Prefect, which reads them on import."""

from __future__ import annotations

import os

for name, value in {
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "120",  # the default of 20 is too short on a busy machine
    "PREFECT_FLOWS_HEARTBEAT_FREQUENCY": "30",  # seconds; detects runs whose process died (docs/deploy.md)
}.items():
    os.environ.setdefault(name, value)
