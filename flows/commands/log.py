"""The log file of a run, `run.log`: settings, start and end of each task, messages of steps, tracebacks of errors."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from scan2sim.flows.reports.side_products import SideProducts
from scan2sim.pipeline.core.errors import ScanError, from_os_error


class Log:
    """Appends to a log file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, *lines: str) -> None:
        """Append lines; the first one gets a timestamp."""
        with open(self.path, "a", encoding="utf-8", errors="backslashreplace") as file:  # paths may not be UTF-8
            now = datetime.now().isoformat(" ", "milliseconds")
            file.write(f"{now} " + "".join(f"{line.rstrip()}\n" for line in lines))

    def write_failed(self, side: SideProducts) -> None:
        """Append the side products that failed, with their tracebacks."""
        for text, error in zip(side.warnings(), side.failed.values(), strict=True):
            self.write(text, *getattr(error, "__notes__", ()))

    @contextmanager
    def errors(self, out: Path) -> Iterator[None]:
        """Log errors raised in the context and re-raise them; an `OSError` becomes a `ScanError` about `out`."""
        try:
            yield
        except ScanError as error:
            self.write(f"error: {error}", *getattr(error, "__notes__", traceback.format_exception(error)))
            raise
        except OSError as error:
            raise from_os_error(error, out) from error
