"""Libraries that nearly every step needs, imported once by the server from which task processes are forked."""

import cv2  # noqa: F401
import numba  # noqa: F401
import numpy  # noqa: F401
import open3d  # noqa: F401
import scipy.spatial  # noqa: F401
