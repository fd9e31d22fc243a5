"""The process that reads damaged files: one for hundreds of them, bounded, and started anew when it dies."""

from __future__ import annotations

import json
import os
import re
import resource
import sys
import traceback
from pathlib import Path

MOST = 6 << 30
"""Bytes of data that a process may ask for: what goes wild ends in an error, not in the machine's."""


def main() -> None:
    """Read cases, a JSON a line (`kind`, `folder`), and answer each: `code`, `said`, `mb`."""
    wire = os.fdopen(os.dup(1), "w")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    resource.setrlimit(resource.RLIMIT_DATA, (MOST, MOST))
    from scan2sim.flows.cli import replace_what_cannot_be_encoded
    from tests.fuzz.kinds import KINDS

    replace_what_cannot_be_encoded()

    for line in sys.stdin:
        case = json.loads(line)
        _forget_peak()
        said, code = "", 0
        try:
            KINDS[case["kind"]].read(Path(case["folder"]))
        except BaseException as error:  # panics of native code are no Exceptions
            code, said = _outcome(error)
        print(json.dumps({"code": code, "said": said, "mb": _peak()}), file=wire, flush=True)


def _outcome(error: BaseException) -> tuple[int, str]:
    """As the command's `main` tells it; an error that the table doesn't know with all that is known of it."""
    from scan2sim.pipeline.core.errors import ScanError, exit_code, from_os_error

    if isinstance(error, OSError):
        error = from_os_error(error, error.filename or "a file")
    code = exit_code(error)
    known = isinstance(error, ScanError) and code != 1
    return code, str(error)[:400] if known else "".join(traceback.format_exception(error))[-3000:]


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")


def _peak() -> float:
    found = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text(encoding="utf-8"))
    return int(found[1]) / 1024 if found else 0.0
