"""Side products (roads, pictures, reports, ...): one that fails costs a warning and an exit code, never the world."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from scan2sim.flows.pipelines.graph import NodeId
from scan2sim.flows.reports.findings import without
from scan2sim.pipeline.core.errors import IncompleteError, ScanError, from_exception


class SideProducts:
    """Collects the side products of a run that failed: steps, and what is written after them.

    Attributes:
        out: folder of the run.
        failed: errors by full name (`street_0001/roads`, `report`); what is in the log of each is in its notes.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self.failed: dict[str, ScanError] = {}

    def add(self, failed: Mapping[NodeId, ScanError]) -> None:
        """Add steps that failed."""
        self.failed |= {node.full_name: error for node, error in failed.items()}

    @contextmanager
    def attempt(self, name: str, *files: Path) -> Iterator[None]:
        """Catch whatever fails within and record it under `name`; then its earlier `files` are removed."""
        try:
            yield
        except Exception as error:
            self.failed[name] = from_exception(error, name, self.out)
            self.failed[name].add_note(traceback.format_exc())
            for file in files:
                file.unlink(missing_ok=True)

    def of_tile(self, tile: str) -> dict[str, ScanError]:
        """Those of a survey's tile, by their names within it; of "" those that are of no tile."""
        names = {name: name.rpartition("/") for name in self.failed}
        return {part: self.failed[name] for name, (owner, _, part) in names.items() if owner == tile}

    def warnings(self) -> list[str]:
        """A sentence on each."""
        return [f"{name}: {without(name, error)}" for name, error in self.failed.items()]

    def check(self) -> None:
        """Raise an IncompleteError that names those that failed, if any."""
        if self.failed:
            what = "a side product failed" if len(self.failed) == 1 else f"{len(self.failed)} side products failed"
            cause = f"the world is finished, but {what}: {', '.join(self.failed)}"
            raise IncompleteError(self.out / "world", cause)
