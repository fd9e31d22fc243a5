"""The machine that a service runs on, and what the service takes of it."""

from __future__ import annotations

import shutil
import subprocess
import time
from dataclasses import dataclass, replace

import psutil

QUERY = ("clocks.max.sm", "memory.total", "utilization.gpu")


@dataclass(frozen=True)
class Machine:
    """What a machine has; None: no graphics processor, or it doesn't say.

    Attributes:
        cpu_cores: that this process may use.
        cpu_frequency, gpu_frequency: MHz.
        gpu_memory: MB.
    """

    cpu_cores: int
    cpu_frequency: float | None
    gpu_cores: int | None
    gpu_frequency: float | None
    gpu_memory: float | None


def machine() -> Machine:
    """This one."""
    frequency = psutil.cpu_freq()
    gpu = _gpu()
    return Machine(
        cpu_cores=len(psutil.Process().cpu_affinity() or ()) or psutil.cpu_count() or 1,
        cpu_frequency=(frequency.max or frequency.current or None) if frequency else None,
        gpu_cores=None,  # nvidia-smi doesn't say
        gpu_frequency=gpu[0] if gpu else None,
        gpu_memory=gpu[1] if gpu else None,
    )


def _gpu() -> tuple[float, float, float] | None:
    """Clock (MHz), memory (MB) and load (%) of the first graphics processor."""
    if shutil.which("nvidia-smi") is None:
        return None
    command = ["nvidia-smi", f"--query-gpu={','.join(QUERY)}", "--format=csv,noheader,nounits"]
    done = subprocess.run(command, capture_output=True, text=True)
    try:
        clock, memory, load = (float(value) for value in done.stdout.splitlines()[0].split(","))
    except (IndexError, ValueError):
        return None
    return clock, memory, load


@dataclass(frozen=True)
class Usage:
    """What a process and those that it started take, from a moment on.

    Attributes:
        cpu_seconds: of all cores; cpu_percent: of the machine's capacity.
        memory_mb: at most.
        gpu_percent: mean load of the first graphics processor; None: there is none.
    """

    process: psutil.Process
    began: float
    before: float
    cpu_seconds: float = 0.0
    memory_mb: float = 0.0
    seconds: float = 0.0
    gpu_loads: tuple[float, ...] = ()

    @classmethod
    def of(cls, process: psutil.Process) -> Usage:
        """From now on."""
        return cls(process, time.monotonic(), _cpu_seconds(process))

    def updated(self) -> Usage:
        """Until now."""
        gpu = _gpu()
        return replace(
            self,
            cpu_seconds=_cpu_seconds(self.process) - self.before,
            memory_mb=max(self.memory_mb, sum(one.memory_info().rss for one in _family(self.process)) / 2**20),
            seconds=time.monotonic() - self.began,
            gpu_loads=(*self.gpu_loads, *([gpu[2]] if gpu else [])),
        )

    @property
    def cpu_percent(self) -> float:
        """Of the machine's capacity."""
        return 100 * self.cpu_seconds / max(self.seconds, 1e-9) / machine().cpu_cores

    @property
    def gpu_percent(self) -> float | None:
        """Mean."""
        return sum(self.gpu_loads) / len(self.gpu_loads) if self.gpu_loads else None


def _family(process: psutil.Process) -> list[psutil.Process]:
    return [process, *process.children(recursive=True)]


def _cpu_seconds(process: psutil.Process) -> float:
    found = 0.0
    for one in _family(process):
        try:
            times = one.cpu_times()
        except psutil.NoSuchProcess:
            continue
        found += times.user + times.system
    return found
