"""Output folders: what a run would replace there must be from an earlier run, not the user's."""

from __future__ import annotations

from collections.abc import Container
from pathlib import Path

from scan2sim.flows.engine.planning import STORE
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.io.worlds.merge import STAMP_FILE

BEFORE_RESULTS = (".lock", "run.log")
"""Files that a run writes before its first result."""


def check_own(out: Path, results: Container[str] | None = None) -> None:
    """Check that files and folders which a run would replace are from an earlier run, recognized by its cached results.

    Args:
        out: the output folder, which may not exist.
        results: names that the run replaces; None: any.

    Raises:
        SettingError: one of them isn't.
    """
    if not out.is_dir() or (out / STORE).is_dir() or (out / "world" / STAMP_FILE).is_file():
        return
    for path in sorted(out.iterdir()):
        if path.name not in BEFORE_RESULTS and (results is None or path.name in results):
            raise SettingError(path, "isn't from an earlier run, and would be replaced", "Choose another --out")
