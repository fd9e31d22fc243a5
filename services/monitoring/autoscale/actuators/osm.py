"""Replicas of an instance that Open Source MANO runs: as many as the bus asks for (docs/orchestration.md)."""

from __future__ import annotations

import logging
import threading

from scan2sim.pipeline.core.errors import ScanError
from scan2sim.services.orchestration import operations
from scan2sim.services.orchestration.lifecycle import Patience
from scan2sim.services.orchestration.osm import Osm
from scan2sim.services.orchestration.settings import Connection

log = logging.getLogger(__name__)

AGAIN = 30.0
"""Seconds before what failed is tried again."""


class OsmReplicas:
    """So many of an instance's function (`actuators.Actuator`); OSM is asked in a thread, one change after another."""

    def __init__(self, connection: Connection, instance: str) -> None:
        """Of an instance that runs; it stays as it is when this ends."""
        self._osm, self._instance = Osm(connection), instance
        self._wanted, self._there = 0, 0
        self._changed, self._ended = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._keep, name=f"replicas of {instance}", daemon=True)
        self._thread.start()

    def scale(self, count: int) -> None:
        """Have so many; returns at once."""
        self._wanted = count
        self._changed.set()

    def workers(self) -> int:
        """Those that there are, as far as OSM said."""
        return self._there

    def close(self) -> None:
        """Change nothing more."""
        self._ended.set()
        self._changed.set()
        self._thread.join()
        self._osm.close()

    def _keep(self) -> None:
        while not self._ended.is_set():
            self._changed.wait(AGAIN if self._wanted != self._there else None)
            self._changed.clear()
            wanted = self._wanted
            if self._ended.is_set() or wanted == self._there:
                continue
            try:
                patience = Patience(stop=self._ended.is_set)
                operations.resize(self._osm, self._instance, wanted, patience, lambda text: log.info("%s", text))
            except ScanError as error:
                log.warning("%s", error)
            else:
                self._there = wanted
