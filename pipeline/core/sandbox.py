"""Run native code that can hang or crash in a child process with a time limit."""

from __future__ import annotations

import ctypes
import importlib
import os
import pickle
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.open3d_import import leave_out_plots


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
    with tempfile.TemporaryDirectory(prefix="scan2sim-") as folder:
        exchange = Path(folder)
        (exchange / "in").write_bytes(pickle.dumps((target, args), protocol=5))
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", "scan2sim.pipeline.core.sandbox", folder],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,
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
            lines = stderr.decode(errors="replace").strip().splitlines()
            cause = lines[-1] if lines and child.returncode > 0 else f"crashed (exit status {child.returncode})"
            raise StepError(target, cause, "Try another seed, backend or resolution")
        return pickle.loads((exchange / "out").read_bytes())


def die_with_parent() -> None:
    """Have the kernel kill this process when its parent dies (Linux only; no effect elsewhere)."""
    if sys.platform == "linux":
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _main(folder: Path) -> None:
    die_with_parent()
    leave_out_plots()
    target, args = pickle.loads((folder / "in").read_bytes())
    module, function = target.split(":")
    result = getattr(importlib.import_module(module), function)(*args)
    (folder / "out").write_bytes(pickle.dumps(result, protocol=5))


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
