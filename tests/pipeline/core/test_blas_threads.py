"""Number of OpenBLAS threads: limited within a context, and restored after it."""

from __future__ import annotations

import subprocess
import sys

CODE = """
import os
os.environ["OPENBLAS_NUM_THREADS"] = "2"
import numpy, scipy.linalg
from scan2sim.pipeline.core import blas_threads
counts = lambda: [blas_threads.function(one, "get")() for one in blas_threads._libraries()]
before = counts()
try:
    with blas_threads.one_blas_thread():
        inside = counts()
        raise KeyError
except KeyError:
    pass
assert before and before == counts(), (before, counts())
assert inside == [1] * len(before), inside
"""


def test_context_limits_blas_to_one_thread_and_restores_the_number() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
