"""Flows, and the command, of worlds whose side products failed; run as a script by `test_incomplete.py`."""

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


def made(*_: object, **__: object) -> Path:
    """As `run_tile` and `make_survey` end where roads failed."""
    raise IncompleteError("out/world", "the world is finished, but a side product failed: roads")


def main(out: str) -> None:
    """Print the final state of each flow; then run the command."""
    here = "scan2sim.flows.deployed"
    with (
        patch(f"{here}.tile.run_tile", made),
        patch(f"{here}.survey.make_survey", made),
        patch(f"{here}.survey.survey_of", lambda source, *_, **__: source),
        patch(f"{here}.reprocess.survey_of", lambda source, *_, **__: source),
        patch(f"{here}.reprocess.changes", lambda *_: {"street": "roads: it was never run"}),
        patch.object(sys, "argv", ["scan2sim", "survey", "somewhere", "--out", out, "--runner", "threads"]),
    ):
        for flow in (tile, survey, reprocess):
            state = flow("somewhere", out, return_state=True)
            print(f"{flow.name}: {state.type.value} {state.name}: {state.message} {state.result()}")
        cli.main()


if __name__ == "__main__":
    main(sys.argv[1])
