"""Parts of a step's result (of one photo, say) that its next run reuses: a change of one part costs only that part.

A part's key covers all that it is computed from, so that a result never depends on earlier runs. Its files are hard
links to those of the result that used it last, and take no space of their own.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

LISTED = "files.json"
"""File of a part that lists its files: name to SHA-256."""


def file_digest(path: Path) -> str:
    """SHA-256 of a file; "missing" if it can't be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return "missing"


class Parts:
    """The parts of the results of one task.

    Args:
        folder: where they are stored; None: nowhere.
        step: what computes all of them: name and version of the step.
    """

    def __init__(self, folder: Path | None = None, *step: object) -> None:
        self._folder, self._step = folder, step
        self._used: set[str] = set()
        self.reused = 0

    def provide(self, out: Path, made_from: Iterable[Any], make: Callable[[], Iterable[Path]]) -> None:
        """Put the files of a part into `out`: those of an earlier run, or new ones.

        Args:
            out: folder of the result that contains the part's files.
            made_from: all that the part is computed from, as JSON values: settings, digests of files.
            make: writes the files, and returns their paths below `out`.
        """
        if self._folder is None:
            make()
            return
        text = json.dumps([*self._step, *made_from], sort_keys=True)
        key = hashlib.sha256(text.encode()).hexdigest()[:24]
        self._used.add(key)
        part = self._folder / key
        if _linked(part, out):
            self.reused += 1
            return
        shutil.rmtree(part, ignore_errors=True)
        files = {path.relative_to(out).as_posix(): path for path in make()}
        try:
            for name, path in files.items():
                (part / name).parent.mkdir(parents=True, exist_ok=True)
                os.link(path, part / name)
            part.mkdir(parents=True, exist_ok=True)
            listed = json.dumps({name: file_digest(path) for name, path in files.items()})
            (part / LISTED).write_text(listed, encoding="utf-8")  # last: it makes the part valid
        except OSError:
            shutil.rmtree(part, ignore_errors=True)  # no hard links here, or no space: computed again next time

    def sweep(self) -> None:
        """Remove the parts that were not used since this object was created."""
        for path in self._folder.iterdir() if self._folder is not None and self._folder.is_dir() else ():
            if path.name not in self._used:
                shutil.rmtree(path, ignore_errors=True)


NO_PARTS = Parts()
"""Reuses nothing."""


def _linked(part: Path, out: Path) -> bool:
    """Link the files of a part into `out`, if they are as they were written."""
    linked: list[Path] = []
    try:
        listed: dict[str, str] = json.loads((part / LISTED).read_text(encoding="utf-8"))
        if any(file_digest(part / name) != expected for name, expected in listed.items()):
            return False
        for name in listed:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            linked.append(out / name)
            os.link(part / name, out / name)
    except (OSError, ValueError, AttributeError):
        for path in linked:  # what is written there would change other results, too
            path.unlink(missing_ok=True)
        return False
    return True
