"""Run native code that can hang or crash in a child process with a time limit."""

from __future__ import annotations

import ctypes
import importlib
import os
import pickle
import re
import signal
import subprocess
import sys
import traceback
from typing import Any

from scan2sim.pipeline.core.anonymous_file import anonymous_file
from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.open3d_import import leave_out_plots

COLOURS = re.compile(r"\x1b\[[0-9;]*m")
"""Escape sequences for the colours of a terminal."""


def call(target: str, *args: Any, timeout: float, threads: int | None = None) -> Any:
    """Run `target` ("module:function") on `args` in a child process and return its result.

    Args:
        target: an importable function; arguments and result are pickled.
        timeout: seconds, after which the child is killed.
        threads: number of threads for native code; None: all cores.

    Raises:
        StepError: the child crashed, raised, or ran out of time.
    """
    # the parent's search path: modules in the user's working folder must not shadow ours
    folders = [folder for folder in sys.path if isinstance(folder, str) and folder]  # Python skips others, too
    environment = dict(os.environ, OMP_WAIT_POLICY="passive", PYTHONPATH=os.pathsep.join(folders))
    if threads is not None:
        environment |= {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
    with anonymous_file() as given, anonymous_file() as returned:
        files = given.fileno(), returned.fileno()
        _write(files[0], (target, args))
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", "scan2sim.pipeline.core.sandbox", *map(str, files)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,
            pass_fds=files,
        )
        try:
            _, stderr = child.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            raise StepError(target, f"did not finish within {timeout:.0f} s", "Use a smaller tile") from None
        finally:  # also when the run is interrupted
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)
                child.wait()
        if child.returncode != 0:
            lines = [line for line in COLOURS.sub("", stderr.decode(errors="replace")).splitlines() if line.strip()]
            cause = lines[-1] if lines and child.returncode > 0 else f"crashed (exit status {child.returncode})"
            raise StepError(target, cause, "Try another seed, backend or resolution")
        return _read(files[1])


def _write(file: int, value: object) -> None:
    with open(file, "wb", closefd=False) as stream:
        pickle.dump(value, stream, protocol=5)


def _read(file: int) -> Any:
    os.lseek(file, 0, os.SEEK_SET)  # the position is that of the process that wrote it
    with open(file, "rb", closefd=False) as stream:
        return pickle.load(stream)


def die_with_parent() -> None:
    """Have the kernel kill this process when its parent dies (Linux only; no effect elsewhere)."""
    if sys.platform == "linux":
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _main(given: int, returned: int) -> None:
    die_with_parent()
    leave_out_plots()
    target, args = _read(given)
    module, function = target.split(":")
    result = getattr(importlib.import_module(module), function)(*args)
    _write(returned, result)


if __name__ == "__main__":
    status = 1
    try:
        _main(int(sys.argv[1]), int(sys.argv[2]))
        status = 0
    except Exception:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)  # without freeing anything: native libraries can hang or crash there, too
