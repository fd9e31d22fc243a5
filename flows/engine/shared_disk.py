"""Checks that workers on other machines see the disk of the flow: each writes results where all others read them."""

from __future__ import annotations

import platform
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import ScanError, WorkerError, from_os_error

MARK_PREFIX = ".run-"
"""First characters of the name of a file that a flow leaves beside the cached results while its workers run."""


@dataclass(frozen=True)
class SharedDisk:
    """A flow's disk, as its workers check it.

    Attributes:
        mark: name of a new file in the folder of cached results; None: results are in object storage.
        host: name of the flow's machine.
    """

    mark: str | None
    host: str

    def check(self, store: Store) -> None:
        """Check that this machine sees the folder that the flow writes to.

        Raises:
            WorkerError: it has another folder there, or none; no step may write there.
        """
        if self.mark is None:
            return
        try:
            store.revalidate()
            (store.root / self.mark).stat()
        except OSError as error:
            raise WorkerError(
                f"{store.root} on {platform.node()}",
                f"isn't the folder that the flow on {self.host} writes to ({error.strerror})",
                "Mount the disk of --out at the same path on all machines, or use object storage for --out",
            ) from None

    def name_worker(self, error: ScanError) -> None:
        """Add the name of this machine to an error's cause, unless the flow runs here."""
        if platform.node() != self.host:
            error.cause += f" (on {platform.node()})"


@contextmanager
def shared(store: Store) -> Iterator[SharedDisk]:
    """Mark the folder of cached results while workers on other machines run a plan.

    Raises:
        ScanError: the folder can't be written.
    """
    if store.remote is not None:
        yield SharedDisk(None, platform.node())
        return
    path = store.root / f"{MARK_PREFIX}{uuid.uuid4().hex}"
    try:
        store.root.mkdir(parents=True, exist_ok=True)
        for left in store.root.glob(f"{MARK_PREFIX}*"):  # of a killed flow
            left.unlink(missing_ok=True)
        path.touch()
    except OSError as error:
        raise from_os_error(error, path) from None
    try:
        yield SharedDisk(path.name, platform.node())
    finally:
        path.unlink(missing_ok=True)
