"""The toy survey as a Prefect flow, with the same tasks as a real one; the kill tests run `main` as a script."""

from __future__ import annotations

import sys
from pathlib import Path
from unittest.mock import patch

import scan2sim.flows.deployed.prefect_settings  # noqa: F401  # isort: skip
from prefect import flow
from prefect.client.schemas.objects import State
from prefect.states import Completed

from scan2sim.flows.deployed.tile import prefect_executor
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.progress import published
from scan2sim.flows.engine.versions import versions
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import BusyError
from tests.flows.prefect.toy_steps import STEPS, planned


def toy_tiles(
    folder: str, tiles: int, gate: str | None, runner: str, pretend: str | None, bus: str | None
) -> int:  # fmt: skip
    """Run all tiles; returns the sum of their results."""
    pretended = {**versions(), **({"scan2sim": pretend} if pretend else {})}
    with published(bus, "survey", folder, local=False) as on_bus:
        with patch("scan2sim.flows.deployed.tile.versions", lambda: pretended):
            run = prefect_executor(runner, 2, bus=on_bus)
        outcome = run(planned(Path(folder), tiles, Path(gate) if gate else None), Store(Path(folder) / "steps"))
        outcome.check()
    return sum(outcome.of_tile(str(tile))[STEPS[-1]].metrics["total"] for tile in range(tiles))


@flow(name="toy")
def toy_survey(
    folder: str, tiles: int = 1, gate: str | None = None, runner: str = "threads", pretend: str | None = None,
    bus: str | None = None,
) -> State:  # fmt: skip
    """One run at a time, like `reprocess`; `pretend` replaces the version of the project."""
    try:
        with locked(Path(folder)):
            total = toy_tiles(folder, tiles, gate, runner, pretend, bus)
    except BusyError as error:
        return Completed(message=f"Skipped: {error}", name="Skipped")
    return Completed(message=f"total {total}", data=total)


def main() -> None:
    """FOLDER TILES RUNNER GATE [BUS]."""
    folder, tiles, runner, gate = sys.argv[1:5]
    bus = sys.argv[5] if len(sys.argv) > 5 else None
    print("total", toy_survey(folder, tiles=int(tiles), gate=gate, runner=runner, bus=bus))
