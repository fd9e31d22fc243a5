"""Process that reads damaged files: reused for hundreds of them, with limited memory, restarted when it dies."""

from __future__ import annotations

import json
import os
import re
import resource
import sys
import time
import traceback
from pathlib import Path

MAX_DATA_BYTES = 6 << 30
"""Data segment limit of the process: runaway allocations end in an error and don't exhaust the machine's memory."""


def main() -> None:
    """Read cases (one JSON object per line: `kind`, `folder`), and print an outcome each."""
    output = os.fdopen(os.dup(1), "w")
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    resource.setrlimit(resource.RLIMIT_DATA, (MAX_DATA_BYTES, MAX_DATA_BYTES))
    from scan2sim.flows.commands.process import replace_unencodable_characters
    from tests.fuzz.kinds import KINDS

    replace_unencodable_characters()

    for line in sys.stdin:
        case = json.loads(line)
        _reset_peak_memory()
        message, code, began = "", 0, time.process_time()
        try:
            KINDS[case["kind"]].read(Path(case["folder"]))
        except BaseException as error:  # panics of native code aren't Exceptions
            code, message = _outcome(error)
        seconds = time.process_time() - began
        outcome = {"code": code, "message": message, "seconds": seconds, "mb": _peak_memory_mb()}
        print(json.dumps(outcome), file=output, flush=True)


def _outcome(error: BaseException) -> tuple[int, str]:
    """Exit code and message as in the command's `main`; with the traceback if the error has no exit code of its own."""
    from scan2sim.pipeline.core.errors import ScanError, exit_code, from_os_error

    if isinstance(error, OSError):
        error = from_os_error(error, error.filename or "a file")
    code = exit_code(error)
    known = isinstance(error, ScanError) and code != 1
    return code, str(error)[:400] if known else "".join(traceback.format_exception(error))[-3000:]


def _reset_peak_memory() -> None:
    Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")


def _peak_memory_mb() -> float:
    found = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text(encoding="utf-8"))
    return int(found[1]) / 1024 if found else 0.0
