"""Wall time and peak memory of a command with all its children."""

from __future__ import annotations

import subprocess
import time
from dataclasses import dataclass

import psutil

SAMPLE_PERIOD_S, MAX_SAMPLING_SHARE = 0.1, 0.03
"""Interval between two samples of memory, and maximum share of the time for sampling, which costs a core's time."""


@dataclass(frozen=True)
class Measurement:
    """seconds: wall time; peak_gb: largest sum of the proportional set sizes of all processes; status: exit status."""

    seconds: float
    peak_gb: float
    status: int


def measure(command: list[str]) -> Measurement:
    """Run a command to its end without capturing its output."""
    start = time.perf_counter()
    child = psutil.Popen(command)
    peak = 0
    while child.poll() is None:
        began = time.perf_counter()
        peak = max(peak, _memory(child))
        time.sleep(max(SAMPLE_PERIOD_S, (time.perf_counter() - began) / MAX_SAMPLING_SHARE))
    return Measurement(time.perf_counter() - start, peak / 1e9, child.returncode)


def _memory(process: psutil.Process) -> int:
    total = 0
    try:
        processes = [process, *process.children(recursive=True)]
    except psutil.Error:
        return 0
    for member in processes:
        try:
            total += member.memory_full_info().pss  # counts shared pages once over all processes
        except (psutil.Error, AttributeError):
            continue
    return total


def output(command: list[str]) -> str:
    """Standard output of a command."""
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
