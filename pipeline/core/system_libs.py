"""Libraries of the system that the wheels load, and Debian's packages that hold them.

`python -m bench.packaging.libraries` holds this table against every shared object of every wheel; `packages.txt` lists
the packages. Needs nothing but Python: `deploy/install.py` reads it before anything is installed.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import sys

from scan2sim.pipeline.core.errors import UnavailableError

PACKAGE_OF = {
    "libEGL.so.1": "libegl1",  # Open3D, this and the next five, though nothing is drawn on a screen
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libidn2.so.0": "libidn2-0",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libexpat.so.1": "libexpat1",  # GDAL, in rasterio
    "libgomp.so.1": "libgomp1",  # numba
}


def missing() -> dict[str, str]:
    """Libraries that can't be loaded here, and their packages; wheels for other systems than Linux need none."""
    return {name: package for name, package in PACKAGE_OF.items() if sys.platform == "linux" and not loads(name)}


def check() -> None:
    """Go on only if this system has all libraries.

    Raises:
        UnavailableError: it hasn't; names them, their packages, and what installs them here.
    """
    lacking = missing()
    if lacking:
        cause = "the system lacks what Open3D and numba load"
        raise UnavailableError(", ".join(lacking), cause, f"Run: {command(lacking)}")


def command(lacking: dict[str, str]) -> str:
    """What installs libraries (and their packages) on this system."""
    sudo = "" if os.geteuid() == 0 else "sudo "
    if shutil.which("apt-get"):
        return f"{sudo}apt-get install --no-install-recommends {' '.join(lacking.values())}"
    for manager in ("dnf", "zypper"):  # RPM knows packages by the libraries in them
        if shutil.which(manager):
            return f"{sudo}{manager} install " + " ".join(f"'{name}()(64bit)'" for name in lacking if ".so" in name)
    return f"your system's package manager, for {', '.join(lacking)}"


def loads(library: str) -> bool:
    """Whether a library is here, by the name that others ask for it."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
