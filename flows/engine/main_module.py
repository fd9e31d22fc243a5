"""Keeps the main module of a program out of the processes of its steps, in the server from which they are forked.

Processes of steps run functions of this package only, but Python imports the main module of the program in each process
that isn't a plain fork. A user's script that calls `scan2sim.run` without `if __name__ == "__main__"` would run again,
and Prefect's engine would be imported for each step. Other processes of the program are as they always are.
"""

from __future__ import annotations

from collections.abc import Callable
from multiprocessing import current_process, spawn

STEP = "scan2sim step"
"""Name of the processes."""


def _unless_step(import_main: Callable[[str], None]) -> Callable[[str], None]:
    def import_for_others(main: str) -> None:
        if current_process().name != STEP:
            import_main(main)

    return import_for_others


for _name in ("_fixup_main_from_name", "_fixup_main_from_path"):
    setattr(spawn, _name, _unless_step(getattr(spawn, _name)))
