"""What nearly every step needs, imported once by the server from which task processes are forked.

Steps and Numba's type tables are included: the demo's 59 processes take 52 s with them, 55 s with the libraries alone
(`python -m bench.profile`).

Task processes run functions of this package only. Python would import the main module of the program again in each of
them: a user's script that calls `scan2sim.run` without `if __name__ == "__main__"` would run again, and Prefect's
engine would be imported for each step.
"""

from importlib import import_module
from multiprocessing import spawn

import cv2  # noqa: F401
import laspy  # noqa: F401
import numba.core.boxing  # noqa: F401
import numpy  # noqa: F401
import PIL.Image  # noqa: F401
import pyproj  # noqa: F401
import scipy.ndimage
import scipy.spatial  # noqa: F401
from numba.core.registry import cpu_target

import scan2sim.flows.pipelines.steps  # noqa: F401
from scan2sim.pipeline.core.open3d_import import leave_out_plots

spawn._fixup_main_from_name = spawn._fixup_main_from_path = lambda _: None  # type: ignore[attr-defined]
leave_out_plots()
import_module("open3d")

cpu_target.typing_context.refresh()
cpu_target.target_context.refresh()
