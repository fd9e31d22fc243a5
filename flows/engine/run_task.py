"""Runs one task in this process and caches its result."""

from __future__ import annotations

import os
import resource
import shutil
import time
from pathlib import Path
from typing import Any

from scan2sim.flows.engine.planning import PlannedTask
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import ScanError, from_exception
from scan2sim.pipeline.core.step import Report, silent


def run_task(item: PlannedTask, store: Store, inputs: dict[str, Path], report: Report = silent) -> Manifest:
    """Run one task in this process and commit its result to the store.

    Raises:
        DamagedError: a cached result that it reads is damaged.
        ScanError: raised by the step; a full disk as `SpaceError`, any other exception as `StepError`.
    """
    task = item.task
    item.check(store)
    content_key = item.content_key(store)
    folder = store.begin(task.full_name)
    start, cpu = time.perf_counter(), _cpu_seconds()
    _reset_peak_memory()
    try:
        parts = store.parts(task.full_name, task.step)
        kept: dict[str, Any] = {"parts": parts} if task.step.parts else {}
        kept |= {"checkpoint": store.checkpoint(task.full_name, item.key)} if task.step.resumes else {}
        result = task.step.run(inputs, task.params, folder, report, **kept)
        about = {
            "version": task.step.version,
            "params": task.params.model_dump(mode="json"),
            "inputs": item.keys,
            "inputs_digest": content_key,
            "seconds": round(time.perf_counter() - start, 3),
            "cpu_seconds": round(_cpu_seconds() - cpu, 3),
            "peak_mb": _peak_mb(),
        }
        manifest = store.commit(task.full_name, item.key, folder, result, about)
        parts.sweep()
        return manifest
    except ScanError:
        raise
    except Exception as error:
        raise from_exception(error, task.full_name, folder) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)  # already moved into the store, unless the step failed


def _cpu_seconds() -> float:
    """CPU time of this process and its ended children, seconds."""
    return sum(os.times()[:4])


def _reset_peak_memory() -> None:
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")
    except OSError:
        pass  # not Linux: the peak includes what the process did before


def _peak_mb() -> float:
    """Peak resident memory of this process and of its largest child, MB."""
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
        own = int(status.split("VmHWM:")[1].split()[0])
    except (OSError, IndexError):
        pass
    return round((own + resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss) / 1024, 1)
