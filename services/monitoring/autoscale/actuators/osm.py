"""Actuator for the replicas of a network service instance in Open Source MANO (docs/orchestration.md)."""

from __future__ import annotations

import logging
import threading

from scan2sim.pipeline.core.errors import ScanError
from scan2sim.services.orchestration import operations
from scan2sim.services.orchestration.lifecycle import WaitPolicy
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.settings import Connection
from scan2sim.services.supervision import SupervisedThread

log = logging.getLogger(__name__)

RETRY_PAUSE_S = 30.0
"""Pause before a failed scaling operation is retried."""


class OsmReplicas:
    """Scales the function of an instance (`actuators.Actuator`) in a background thread, one operation at a time."""

    def __init__(self, connection: Connection, instance: str) -> None:
        """`instance`: name of a running instance; it keeps its replicas when this object is closed."""
        self._osm, self._instance = Osm(connection), instance
        self._desired, self._current = 0, 0
        self._changed, self._ended = threading.Event(), threading.Event()
        self._thread = SupervisedThread(self._keep, f"replicas of {instance}")
        self._thread.start()

    def scale(self, count: int) -> None:
        """Set the number of replicas; returns at once."""
        self._desired = count
        self._changed.set()

    def workers(self) -> int:
        """Number of replicas after the last completed operation."""
        return self._current

    def close(self) -> None:
        """Stop scaling; the replicas keep running."""
        self._ended.set()
        self._changed.set()
        self._thread.join()
        self._osm.close()

    def _keep(self) -> None:
        while not self._ended.is_set():
            self._changed.wait(RETRY_PAUSE_S if self._desired != self._current else None)
            self._changed.clear()
            desired = self._desired
            if self._ended.is_set() or desired == self._current:
                continue
            try:
                wait_policy = WaitPolicy(stop=self._ended.is_set)
                operations.scale(self._osm, self._instance, desired, wait_policy, lambda text: log.info("%s", text))
            except ScanError as error:
                log.warning("%s", error)
            else:
                self._current = desired
