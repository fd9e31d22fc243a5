"""Libraries that nearly every step needs, loaded once in the server that node processes fork from."""

import cv2  # noqa: F401
import numba  # noqa: F401
import numpy  # noqa: F401
import open3d  # noqa: F401
import scipy.spatial  # noqa: F401
