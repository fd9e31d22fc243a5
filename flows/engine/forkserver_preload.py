"""What nearly every step needs, imported once by the server from which task processes are forked.

Steps and Numba's type tables are included: the demo's 59 processes take 52 s with them, 55 s with the libraries alone
(`python -m bench.profile`). Garbage collections in the task processes skip them: they would copy the memory that all
processes share.
"""

import atexit
import gc
from importlib import import_module

import scan2sim.flows.engine.thread_limit  # isort: skip  # before the libraries
import cv2  # noqa: F401
import laspy  # noqa: F401
import numba.core.boxing  # noqa: F401
import numpy  # noqa: F401
import PIL.Image  # noqa: F401
import pyproj  # noqa: F401
import scipy.ndimage
import scipy.spatial  # noqa: F401
from numba.core.registry import cpu_target

import scan2sim.flows.engine.main_module
import scan2sim.flows.pipelines.steps  # noqa: F401
from scan2sim.pipeline.core.kernel_cache import run_without_space
from scan2sim.pipeline.core.open3d_import import leave_out_plots

run_without_space()
leave_out_plots()
import_module("open3d")

cpu_target.typing_context.refresh()
cpu_target.target_context.refresh()

gc.collect()
gc.freeze()
atexit.register(gc.unfreeze)  # or libraries report leaks
