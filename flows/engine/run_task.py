"""Runs one node in this process, and keeps its result."""

from __future__ import annotations

import resource
import shutil
import time
from pathlib import Path

from scan2sim.flows.engine.planning import Planned
from scan2sim.pipeline.core.cache import Manifest, Store
from scan2sim.pipeline.core.errors import ScanError, from_exception
from scan2sim.pipeline.core.step import Report, silent


def run_node(item: Planned, store: Store, inputs: dict[str, Path], report: Report = silent) -> Manifest:
    """Run one node in this process and keep its result.

    Raises:
        DamagedError: a result that it reads isn't as it was made.
        ScanError: as the step says; a full disk as `SpaceError`; anything else as `StepError`.
    """
    node = item.node
    item.check(store)
    fed = item.fed(store)
    folder = store.begin(node.full_name)
    start = time.perf_counter()
    _forget_peak()
    try:
        kept = {"checkpoint": store.checkpoint(node.full_name, item.key)} if node.step.resumes else {}
        result = node.step.run(inputs, node.params, folder, report, **kept)
        about = {
            "version": node.step.version,
            "params": node.params.model_dump(mode="json"),
            "inputs": item.keys,
            "fed": fed,
            "seconds": round(time.perf_counter() - start, 3),
            "peak_mb": _peak_mb(),
        }
        return store.commit(node.full_name, item.key, folder, result, about)
    except ScanError:
        raise
    except Exception as error:
        raise from_exception(error, node.full_name, folder) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)  # moved away by now, unless it failed


def _forget_peak() -> None:
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")
    except OSError:
        pass  # not Linux: the peak is then that of the process so far


def _peak_mb() -> float:
    """Peak resident memory of this process and of its largest child, MB."""
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
        own = int(status.split("VmHWM:")[1].split()[0])
    except (OSError, IndexError):
        pass
    return round((own + resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss) / 1024, 1)
