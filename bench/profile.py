"""Where the time of a run goes: by step, by core, and along the critical path.

`python -m bench.profile [TILE ...] [--out bench-out/profile] [--first] [--set STEP.NAME=VALUE]`. Runs each tile
(default: the small one in `data_samples/`) into a new folder and prints per step: wall time from the start of its
process until its result is cached; the part of it *outside* the step (starting the process, checking inputs, hashing,
caching); CPU time; cores used; and how long it waited for a free process after its inputs were ready. The critical path
is the chain of steps of which each was the last that the next one waited for. `--first` runs the first tile before with
an empty cache of compiled kernels, like the first run on a machine. Ends with `RESULT {json}`. Linux only.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import resource
import shutil
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from bench.measure import measure
from bench.paths import ROOT
from scan2sim.pipeline.core.cache import Manifest, read_manifest

PR_SET_CHILD_SUBREAPER = 36
SAMPLE = ROOT / "data_samples" / "tile"


@dataclass(frozen=True)
class Task:
    """A task of a run.

    Attributes:
        manifest: of its result.
        ready, start, end: when its inputs were there, its process began, its result was cached; seconds of the run.
        waited_for: the input that came last; empty if it reads files only.
    """

    manifest: Manifest
    ready: float
    start: float
    end: float
    waited_for: str

    @property
    def outside(self) -> float:
        """Seconds of its process outside the step."""
        return self.end - self.start - self.manifest.seconds


@dataclass(frozen=True)
class Profile:
    """A run: its tasks by name, wall and CPU seconds of the whole command."""

    tasks: dict[str, Task]
    seconds: float
    cpu_seconds: float

    @property
    def cores_busy(self) -> float:
        """Share of the cores' time that the run used."""
        return self.cpu_seconds / self.seconds / (os.cpu_count() or 1)

    @property
    def critical_path(self) -> list[str]:
        """The chain of tasks that ends with the last one, each the last input of the next."""
        name = max(self.tasks, key=lambda task: self.tasks[task].end)
        path = [name]
        while self.tasks[name].waited_for:
            name = self.tasks[name].waited_for
            path.append(name)
        return path[::-1]


def run(tile: Path, out: Path, options: list[str], kernels: Path | None = None) -> Profile:
    """Run a tile into a new folder.

    Args:
        tile: its folder.
        out: output folder, emptied first.
        options: more options of `scan2sim run`.
        kernels: cache of compiled kernels to use instead of the machine's.
    """
    shutil.rmtree(out, ignore_errors=True)
    environment = dict(os.environ)
    if kernels is not None:
        os.environ["NUMBA_CACHE_DIR"] = str(kernels)
    before = _children_cpu()
    command = [str(Path(sys.executable).parent / "scan2sim"), "run", str(tile), "--out", str(out), *options]
    measured = measure(command)
    os.environ.clear()
    os.environ.update(environment)
    if measured.status != 0:
        sys.exit(f"{' '.join(command)}: exit status {measured.status}")
    return Profile(read_tasks(out), measured.seconds, _children_cpu() - before)


def read_tasks(out: Path) -> dict[str, Task]:
    """The tasks of a finished run, from its log and its manifests."""
    manifests = [read_manifest(path) for path in (out / "steps").glob("*/*/manifest.json")]
    by_key = {path.parent.name: path.parent.parent.name for path in (out / "steps").glob("*/*/manifest.json")}
    times: dict[tuple[str, str], float] = {}
    for line in (out / "run.log").read_text(encoding="utf-8").splitlines():
        words = line.split(" ")
        if len(words) == 4 and words[3] in ("start", "done"):
            times[words[2].rstrip(":"), words[3]] = datetime.fromisoformat(f"{words[0]} {words[1]}").timestamp()
    began = min(times.values())
    tasks = {}
    for manifest in manifests:
        assert manifest is not None
        upstream = [by_key[source.split("/")[0]] for source in manifest.inputs.values() if "/" in source]
        last = max(upstream, key=lambda name: times[name, "done"], default="")
        ready = times[last, "done"] if last else began
        start, end = times[manifest.label, "start"], times[manifest.label, "done"]
        tasks[manifest.label] = Task(manifest, ready - began, start - began, end - began, last)
    return tasks


def show(profile: Profile) -> None:
    """Print the table and the critical path."""
    tasks = profile.tasks
    print(f"{'step':<28}{'wall s':>8}{'outside':>9}{'CPU s':>8}{'cores':>7}{'waited':>8}{'GB':>6}")
    for name, task in sorted(tasks.items(), key=lambda one: one[1].start - one[1].end):
        wall, cpu = task.end - task.start, task.manifest.cpu_seconds
        print(
            f"{name:<28}{wall:>8.2f}{task.outside:>9.2f}{cpu:>8.2f}{cpu / max(wall, 1e-3):>7.2f}"
            f"{task.start - task.ready:>8.2f}{task.manifest.peak_mb / 1000:>6.2f}"
        )
    walls, outside = sum(t.end - t.start for t in tasks.values()), sum(t.outside for t in tasks.values())
    cpu = sum(t.manifest.cpu_seconds for t in tasks.values())
    print(f"{f'{len(tasks)} steps':<28}{walls:>8.1f}{outside:>9.1f}{cpu:>8.1f}")
    print(
        f"whole: {profile.seconds:.1f} s, CPU {profile.cpu_seconds:.1f} s, "
        f"cores busy {100 * profile.cores_busy:.0f} % of {os.cpu_count()}"
    )
    path = profile.critical_path
    print("critical path: " + " > ".join(f"{name} {tasks[name].end - tasks[name].start:.1f}" for name in path) + "\n")


def _adopt_orphans() -> None:
    """Become the parent of processes whose parent ends before them: the server that tasks are forked from does."""
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)


def _children_cpu() -> float:
    """CPU seconds of all ended children and theirs, waiting for those that still run."""
    with suppress(ChildProcessError):
        while True:
            os.wait()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Run the tiles and print their profiles."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tiles", nargs="*", type=Path, default=[SAMPLE])
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "profile")
    parser.add_argument("--first", action="store_true", help="also run the first tile with no compiled kernels")
    parser.add_argument("--set", action="append", default=[], help="setting of a step")
    arguments = parser.parse_args()
    _adopt_orphans()
    options = [part for value in arguments.set for part in ("--set", value)]
    result: dict[str, float | dict[str, float]] = {}
    first = None
    if arguments.first:
        with tempfile.TemporaryDirectory() as empty:
            first = run(arguments.tiles[0], arguments.out / "first", options, Path(empty))
            print(f"first run, kernels compiled: {first.seconds:.1f} s, CPU {first.cpu_seconds:.1f} s", flush=True)
    profiles = {}
    for tile in arguments.tiles:
        name = tile.resolve().name
        profiles[name] = run(tile, arguments.out / name, options)
        print(f"\n{name}")
        show(profiles[name])
    total = sum(p.seconds for p in profiles.values())
    result["cores_busy"] = round(sum(p.cpu_seconds for p in profiles.values()) / total / (os.cpu_count() or 1), 3)
    if first is not None:
        result["first_run_ratio"] = round(first.seconds / next(iter(profiles.values())).seconds, 2)
    longest = max(profiles.values(), key=lambda p: p.seconds)
    result["critical_path_s"] = round(
        sum(longest.tasks[name].end - longest.tasks[name].start for name in longest.critical_path), 1
    )
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main()
