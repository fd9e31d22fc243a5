"""Wall time and peak memory of a command with all its children."""

from __future__ import annotations

import subprocess
import time
from dataclasses import dataclass

import psutil

PERIOD, SHARE = 0.1, 0.03
"""Seconds between two looks at memory, and what share of the time looking may take: it costs a core's time."""


@dataclass(frozen=True)
class Measured:
    """seconds of wall time; peak_gb: largest sum of the proportional set sizes of all processes at one time."""

    seconds: float
    peak_gb: float
    status: int


def measure(command: list[str]) -> Measured:
    """Run a command to its end, its output passing through."""
    start = time.perf_counter()
    child = psutil.Popen(command)
    peak = 0
    while child.poll() is None:
        began = time.perf_counter()
        peak = max(peak, _memory(child))
        time.sleep(max(PERIOD, (time.perf_counter() - began) / SHARE))
    return Measured(time.perf_counter() - start, peak / 1e9, child.returncode)


def _memory(process: psutil.Process) -> int:
    total = 0
    try:
        family = [process, *process.children(recursive=True)]
    except psutil.Error:
        return 0
    for member in family:
        try:
            total += member.memory_full_info().pss  # shared pages are counted once over all processes
        except (psutil.Error, AttributeError):
            continue
    return total


def output(command: list[str]) -> str:
    """What a command prints."""
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
