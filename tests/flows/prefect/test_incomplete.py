"""A flow whose world is finished without side products that failed: it completes, and its state says so."""

from __future__ import annotations

import sys
from pathlib import Path

from scan2sim.pipeline.core.errors import IncompleteError, exit_code
from tests.flows.prefect.conftest import Server, on


@on("sqlite")
def test_flows_complete_with_warnings_and_the_command_has_its_exit_code(server: Server, tmp_path: Path) -> None:
    done = server.script(sys.executable, "-m", "tests.flows.prefect.incomplete", str(tmp_path))
    assert done.returncode == exit_code(IncompleteError("", "")), done.stdout
    cause = "the world is finished, but a side product failed: roads"
    for flow, page in (("tile", "report"), ("survey", "survey"), ("reprocess", "survey")):
        assert f"{flow}: COMPLETED CompletedWithWarnings: {cause} {tmp_path / page}.html\n" in done.stdout
    assert f"warning: {tmp_path / 'world'}: {cause}\n" in done.stdout
    assert "Run again to retry what failed" in done.stdout and "Traceback" not in done.stdout
