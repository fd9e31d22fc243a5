"""The command `scan2sim`, and the error that makes a part of the benchmark fail."""

from __future__ import annotations

import sys
from collections.abc import Collection
from pathlib import Path

from bench.measure import Measurement, measure
from bench.paths import ROOT


class Missing(Exception):
    """Part of the product or a recording is missing, or a run failed; the text says which."""


def scan2sim(log: Path, *arguments: object, accepted: Collection[int] = (0,)) -> Measurement:
    """Run the command; its output goes to `log`.

    Raises:
        Missing: its exit status isn't an `accepted` one; with the last lines of its output.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "scan2sim.flows.cli", *map(str, arguments)]
    to_log = 'log=$1; shift; exec "$@" >"$log" 2>&1'
    measured = measure(["env", f"PYTHONPATH={ROOT}", "sh", "-c", to_log, "sh", str(log), *command])
    if measured.status not in accepted:
        lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines()]
        cause = " / ".join([line for line in lines if line][-2:]) or "no output"
        raise Missing(f"scan2sim {arguments[0]} failed with exit status {measured.status}: {cause} ({log})")
    return measured
