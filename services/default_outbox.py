"""Default outbox files in the user's state folder: one per running process; leftovers of dead processes are sent."""

from __future__ import annotations

import os
from pathlib import Path

from scan2sim.pipeline.core.errors import BusyError, SpaceError
from scan2sim.services.outbox import Outbox

MAX_NAME_CHARS = 200
"""File names are cut to this length."""


def open_outbox(node: str, topic: str) -> Outbox:
    """Open the outbox for a node's records on a topic, both given by their full names.

    The first process of that name gets NAME.1.outbox, a second one that runs at the same time NAME.2.outbox, and so on.
    Records left in files that no process has open are moved into the new outbox.

    Raises:
        SpaceError: the state folder can't be created or written.
    """
    name = f"{node}.{topic}".replace("/", ".").strip(".")[:MAX_NAME_CHARS]
    folder, number = state_folder("outboxes"), 1
    while (own := _open_if_free(folder / f"{name}.{number}.outbox")) is None:
        number += 1
    while (path := folder / f"{name}.{(number := number + 1)}.outbox").exists():
        if (abandoned := _open_if_free(path)) is not None:
            own.take_over(abandoned)
            abandoned.close()
    return own


def _open_if_free(path: Path) -> Outbox | None:
    """Open the outbox in a file; None if another process has it open."""
    try:
        return Outbox(path)
    except BusyError:
        return None


def state_folder(purpose: str) -> Path:
    """Folder below the user's state folder (XDG Base Directory Specification 0.8), readable by the user only.

    Raises:
        SpaceError: it can't be created or written.
    """
    try:
        state = os.environ.get("XDG_STATE_HOME")
        path = (Path(state) if state else Path.home() / ".local" / "state") / "scan2sim" / purpose
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.chmod(0o700)
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home folder
        remedy = "Set XDG_STATE_HOME to a writable folder, or name a file (--outbox, --state)"
        raise SpaceError(f"folder for {purpose}", f"can't be used ({error})", remedy) from None
    return path
