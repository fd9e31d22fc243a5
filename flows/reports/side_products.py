"""Side products (roads, images, reports, ...): a failure causes a warning and an exit code, but the world is kept."""

from __future__ import annotations

import shutil
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from scan2sim.flows.pipelines.graph import TaskId
from scan2sim.flows.reports.findings import failure_text
from scan2sim.pipeline.core.cache import Manifest
from scan2sim.pipeline.core.errors import IncompleteError, ScanError, StepError, from_exception


class SideProducts:
    """Collects the failed side products of a run: steps, and files that are written after them.

    Attributes:
        out: output folder of the run.
        failed: errors by full name (`street_0001/roads`, `report`); their notes contain the tracebacks.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self.failed: dict[str, ScanError] = {}

    def add(self, failed: Mapping[TaskId, ScanError], done: Mapping[TaskId, Manifest]) -> None:
        """Add failed steps, and failed parts of results (`street_0001/export.usd`)."""
        self.failed |= {task.full_name: error for task, error in failed.items()}
        for task, manifest in done.items():
            for part, (where, cause, remedy, *notes) in manifest.failed.items():
                error = self.failed[f"{task.full_name}.{part}"] = StepError(where, cause, remedy)
                for note in notes:
                    error.add_note(note)

    @contextmanager
    def attempt(self, name: str, *files: Path) -> Iterator[None]:
        """Record an exception in the context as failure of `name`, and delete `files`, which an earlier run wrote.

        Files may be folders.
        """
        try:
            yield
        except Exception as error:
            self.failed[name] = from_exception(error, name, self.out)
            self.failed[name].add_note(traceback.format_exc())
            for file in files:
                shutil.rmtree(file, ignore_errors=True) if file.is_dir() else file.unlink(missing_ok=True)

    def of_tile(self, tile: str) -> dict[str, ScanError]:
        """Errors of a survey's tile by name within the tile; for "": errors that belong to no tile."""
        names = {name: name.rpartition("/") for name in self.failed}
        return {part: self.failed[name] for name, (owner, _, part) in names.items() if owner == tile}

    def warnings(self) -> list[str]:
        """A sentence about each failure."""
        return [f"{name}: {failure_text(name, error)}" for name, error in self.failed.items()]

    def check(self) -> None:
        """Raise an IncompleteError that names the failed side products, if any."""
        if self.failed:
            what = "a side product failed" if len(self.failed) == 1 else f"{len(self.failed)} side products failed"
            cause = f"the world is finished, but {what}: {', '.join(self.failed)}"
            raise IncompleteError(self.out / "world", cause)
