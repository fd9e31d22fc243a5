"""Hardware of this machine, and the resources used by a process."""

from __future__ import annotations

import shutil
import subprocess
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import psutil

NVIDIA_SMI_FIELDS = ("clocks.max.sm", "memory.total", "utilization.gpu")


@dataclass(frozen=True)
class Machine:
    """Hardware of a machine; None: no GPU, or unknown.

    Attributes:
        cpu_cores: number of cores available to this process.
        cpu_frequency, gpu_frequency: maximum clock in MHz.
        gpu_memory: memory of the GPU in MB.
    """

    cpu_cores: int
    cpu_frequency: float | None
    gpu_cores: int | None
    gpu_frequency: float | None
    gpu_memory: float | None


def machine() -> Machine:
    """Hardware of this machine."""
    import psutil

    frequency = psutil.cpu_freq()
    gpu = _gpu()
    return Machine(
        cpu_cores=len(psutil.Process().cpu_affinity() or ()) or psutil.cpu_count() or 1,
        cpu_frequency=(frequency.max or frequency.current or None) if frequency else None,
        gpu_cores=None,  # not reported by nvidia-smi
        gpu_frequency=gpu[0] if gpu else None,
        gpu_memory=gpu[1] if gpu else None,
    )


def _gpu() -> tuple[float, float, float] | None:
    """Clock (MHz), memory (MB) and load (%) of the first GPU."""
    if shutil.which("nvidia-smi") is None:
        return None
    command = ["nvidia-smi", f"--query-gpu={','.join(NVIDIA_SMI_FIELDS)}", "--format=csv,noheader,nounits"]
    done = subprocess.run(command, capture_output=True, text=True)
    try:
        clock, memory, load = (float(value) for value in done.stdout.splitlines()[0].split(","))
    except (IndexError, ValueError):
        return None
    return clock, memory, load


@dataclass(frozen=True)
class Usage:
    """Resources used by a process and its children since `start`.

    Attributes:
        cpu_seconds: CPU time of all cores; cpu_percent: share of the machine's capacity.
        memory_mb: peak resident memory.
        gpu_percent: mean load of the first GPU; None: no GPU.
    """

    process: psutil.Process
    started_at: float
    initial_cpu_seconds: float
    cpu_seconds: float = 0.0
    memory_mb: float = 0.0
    seconds: float = 0.0
    gpu_loads: tuple[float, ...] = ()

    @classmethod
    def start(cls, process: psutil.Process) -> Usage:
        """Start measuring."""
        return cls(process, time.monotonic(), _cpu_seconds(process))

    def updated(self) -> Usage:
        """Usage up to now."""
        gpu = _gpu()
        return replace(
            self,
            cpu_seconds=_cpu_seconds(self.process) - self.initial_cpu_seconds,
            memory_mb=max(self.memory_mb, sum(one.memory_info().rss for one in _process_tree(self.process)) / 2**20),
            seconds=time.monotonic() - self.started_at,
            gpu_loads=(*self.gpu_loads, *([gpu[2]] if gpu else [])),
        )

    @property
    def cpu_percent(self) -> float:
        """CPU time as a percentage of the machine's capacity."""
        return 100 * self.cpu_seconds / max(self.seconds, 1e-9) / machine().cpu_cores

    @property
    def gpu_percent(self) -> float | None:
        """Mean load of the first GPU."""
        return sum(self.gpu_loads) / len(self.gpu_loads) if self.gpu_loads else None


def _process_tree(process: psutil.Process) -> list[psutil.Process]:
    return [process, *process.children(recursive=True)]


def _cpu_seconds(process: psutil.Process) -> float:
    import psutil

    found = 0.0
    for one in _process_tree(process):
        try:
            times = one.cpu_times()
        except psutil.NoSuchProcess:
            continue
        found += times.user + times.system
    return found


def host_values(host: Machine, usage: Usage) -> dict[str, float | None]:
    """Values of the metrics of `requirements.Requirements` that describe a machine and its usage."""
    return {
        "cpu_cores": host.cpu_cores,
        "cpu_frequency": host.cpu_frequency,
        "cpu_usage": usage.cpu_percent,
        "gpu_cores": host.gpu_cores,
        "gpu_frequency": host.gpu_frequency,
        "gpu_memory": host.gpu_memory,
        "gpu_usage": usage.gpu_percent,
        "memory": usage.memory_mb,
    }
