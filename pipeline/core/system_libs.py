"""System libraries (shared objects) that the wheels load, and the Debian packages that contain them.

`python -m deploy.libraries` compares this table with every shared object of every wheel; `packages.txt` lists
the packages. Uses only the standard library: `deploy/install.py` imports it before anything is installed.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import sys

from scan2sim.pipeline.core.errors import UnavailableError

PACKAGE_OF = {
    "libEGL.so.1": "libegl1",  # this and the next five: Open3D, even when it runs headless
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libidn2.so.0": "libidn2-0",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libexpat.so.1": "libexpat1",  # GDAL, in rasterio
    "libgomp.so.1": "libgomp1",  # numba
}


def missing() -> dict[str, str]:
    """Libraries that can't be loaded, and their packages; empty on other systems than Linux, where wheels need none."""
    return {name: package for name, package in PACKAGE_OF.items() if sys.platform == "linux" and not loads(name)}


def check() -> None:
    """Raise an error unless this system has all libraries.

    Raises:
        UnavailableError: libraries are missing; names them, and the command that installs their packages.
    """
    absent = missing()
    if absent:
        cause = "system libraries that Open3D and numba load are missing"
        raise UnavailableError(", ".join(absent), cause, f"Run: {command(absent)}")


def command(absent: dict[str, str]) -> str:
    """Command that installs missing libraries (keys) by their packages (values) on this system."""
    sudo = "" if os.geteuid() == 0 else "sudo "
    if shutil.which("apt-get"):
        return f"{sudo}apt-get install --no-install-recommends {' '.join(absent.values())}"
    for manager in ("dnf", "zypper"):  # RPM resolves packages by the libraries that they provide
        if shutil.which(manager):
            return f"{sudo}{manager} install " + " ".join(f"'{name}()(64bit)'" for name in absent if ".so" in name)
    return f"your system's package manager, for {', '.join(absent)}"


def loads(library: str) -> bool:
    """Whether a library can be loaded by its soname."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
