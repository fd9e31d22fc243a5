"""Runs the flows and the command with failing side products; executed as a script by `test_deployments.py`."""

from __future__ import annotations

import sys
from pathlib import Path
from unittest.mock import patch

import scan2sim.flows.deployed.prefect_settings  # noqa: F401  # isort: skip

from scan2sim.flows import cli
from scan2sim.flows.deployed.reprocess import reprocess
from scan2sim.flows.deployed.survey import survey
from scan2sim.flows.deployed.tile import tile
from scan2sim.pipeline.core.errors import IncompleteError


def incomplete(*_: object, **__: object) -> Path:
    """Replacement of `run_tile` and `make_survey` that fails like with failed roads."""
    raise IncompleteError("out/world", "the world is finished, but a side product failed: roads")


def main(out: str) -> None:
    """Print the final state of each flow; then run the command."""
    package = "scan2sim.flows.deployed"
    with (
        patch(f"{package}.tile.run_tile", incomplete),
        patch(f"{package}.survey.make_survey", incomplete),
        patch(f"{package}.survey.survey_of", lambda source, *_, **__: source),
        patch(f"{package}.reprocess.survey_of", lambda source, *_, **__: source),
        patch(f"{package}.reprocess.changes", lambda *_: {"street": "roads: never run before"}),
        patch.object(sys, "argv", ["scan2sim", "survey", "somewhere", "--out", out, "--runner", "threads"]),
    ):
        for flow in (tile, survey, reprocess):
            state = flow("somewhere", out, return_state=True)
            print(f"{flow.name}: {state.type.value} {state.name}: {state.message} {state.result()}")
        cli.main()


if __name__ == "__main__":
    main(sys.argv[1])
