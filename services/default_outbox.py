"""Spools that nobody named: in the user's state folder, of one living process each; what dead ones left is sent."""

from __future__ import annotations

import os
from pathlib import Path

from scan2sim.pipeline.core.errors import BusyError, SpaceError
from scan2sim.services.outbox import Spool

LONGEST = 200
"""Characters of a name; what is behind them doesn't count."""


def opened(node: str, topic: str) -> Spool:
    """The spool of a node's records for a topic, by their full names.

    The first process of that name has NAME.1.spool, one that runs beside it NAME.2.spool, and so on. Whatever waits in
    files that no process has is taken over.

    Raises:
        SpaceError: there is no folder for it, and none can be made.
    """
    name = f"{node}.{topic}".replace("/", ".").strip(".")[:LONGEST]
    folder, number = _folder(), 1
    while (own := _free(folder / f"{name}.{number}.spool")) is None:
        number += 1
    while (path := folder / f"{name}.{(number := number + 1)}.spool").exists():
        if (left := _free(path)) is not None:
            own.take_over(left)
            left.close()
    return own


def _free(path: Path) -> Spool | None:
    """The spool in a file; None: another process has it."""
    try:
        return Spool(path)
    except BusyError:
        return None


def _folder() -> Path:
    """Below the user's state folder (XDG Base Directory Specification 0.8), nobody else's to read."""
    try:
        state = os.environ.get("XDG_STATE_HOME")
        path = (Path(state) if state else Path.home() / ".local" / "state") / "scan2sim" / "spools"
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.chmod(0o700)
    except (OSError, RuntimeError) as error:  # the latter: who has no home
        remedy = "Set XDG_STATE_HOME to a folder of yours, or name a file: --spool"
        raise SpaceError("folder for records that wait", f"can't be used ({error})", remedy) from None
    return path
