"""Prefect's settings that these flows run well with; imported before Prefect, which reads them when it is imported."""

from __future__ import annotations

import os

for name, value in {
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "120",  # 20 are too few on a busy machine
    "PREFECT_FLOWS_HEARTBEAT_FREQUENCY": "30",  # by which a run whose process died is found out (docs/deploy.md)
}.items():
    os.environ.setdefault(name, value)
