"""Runs the check of an import's poses in this process, without a cache: for the Python API."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from scan2sim.flows.pipelines.graph import Task
from scan2sim.pipeline.core.step import Report

CHECKED = 0.4
"""Progress of an import when its poses are checked."""


def run_check(task: Task, folder: Path, warn: Callable[[str], None], report: Report) -> Path:
    """Run a task whose inputs are files; returns the folder `check` of its result.

    Args:
        task: the task.
        folder: existing folder for the result.
        warn: receives the task's warnings.
        report: receives progress, up to `CHECKED`.

    Raises:
        ScanError: raised by the step.
    """
    files = {name: path for name, path in task.inputs.items() if isinstance(path, Path)}
    done = task.step.run(files, task.params, folder, lambda part, text="": report(CHECKED * part, text))
    for text in done.warnings:
        warn(text)
    return done.files["check"]
