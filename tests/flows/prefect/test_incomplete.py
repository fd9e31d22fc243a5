"""Flows whose world is finished but side products failed: final state of the flow and exit code of the command."""

from __future__ import annotations

import sys
from pathlib import Path

from scan2sim.pipeline.core.errors import IncompleteError, exit_code
from tests.flows.prefect.conftest import Server, on


@on("sqlite")
def test_incomplete_world_ends_with_a_warning_state_and_exit_code(server: Server, tmp_path: Path) -> None:
    done = server.script(sys.executable, "-m", "tests.flows.prefect.incomplete", str(tmp_path))
    assert done.returncode == exit_code(IncompleteError("", "")), done.stdout
    cause = "the world is finished, but a side product failed: roads"
    for flow, page in (("tile", "report"), ("survey", "survey"), ("reprocess", "survey")):
        assert f"{flow}: COMPLETED CompletedWithWarnings: {cause} {tmp_path / page}.html\n" in done.stdout
    assert f"warning: {tmp_path / 'world'}: {cause}\n" in done.stdout
    assert "Run again to retry what failed" in done.stdout and "Traceback" not in done.stdout
