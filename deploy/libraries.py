"""Check that all shared libraries needed by installed wheels exist on a minimal Debian plus packages.txt.

`python -m deploy.libraries [--here]` checks the current environment. Each library that a shared object needs
(DT_NEEDED) must come with a wheel, with every Debian (`ALWAYS`), or from a package of packages.txt
(`pipeline/core/system_libs.py`); otherwise it is reported and the exit status is 1, even if this machine has it. With
`--here` it must also be found on this machine: run in a minimal system, this verifies both lists.

Ends with `RESULT {json}`: number of shared objects, libraries needed from the system, and missing ones.
"""

from __future__ import annotations

import argparse
import json
import sys
import sysconfig
from collections import defaultdict
from pathlib import Path
from typing import Any

from scan2sim.pipeline.core.system_libs import PACKAGE_OF, loads

ALWAYS = {
    "ld-linux-x86-64.so.2", "libc.so.6", "libdl.so.2", "libm.so.6", "libmvec.so.1", "libpthread.so.0", "librt.so.1",
    "libutil.so.1", "libgcc_s.so.1", "libstdc++.so.6", "libz.so.1",
}  # fmt: skip
"""Libraries of libc6, libgcc-s1, libstdc++6 and zlib1g, which dpkg and apt depend on."""
OTHER_NAMES = {"libgomp.so.1.0.0": "libgomp.so.1"}
"""Full names used by some wheels, with the name of the same library."""
NEVER_LOADED = {
    "libtensorflow_framework.so.2": "Open3D's operators for TensorFlow, never used here",
    "libtorch_cpu.so": "Open3D's operators for PyTorch, never used here",
    "libc10.so": "likewise",
    "libcuda.so.1": "NVIDIA's driver: where there is a GPU, it comes with that",
    "libnvidia-ml.so.1": "likewise",
    "libtbb.so.12": "numba's third choice of threads; it has others",
}
"""Libraries that may be missing, and why."""


def needed_libraries(folder: Path) -> tuple[int, dict[str, list[str]]]:
    """System libraries needed by the shared objects below a folder.

    Returns:
        number of shared objects; files (relative to the folder) by the library that they need.
    """
    from elftools.elf.elffile import ELFFile

    wanted: dict[str, list[str]] = defaultdict(list)
    own: set[str] = set()
    files = [path for path in sorted(folder.rglob("*.so*")) if path.is_file()]
    for path in files:
        with open(path, "rb") as file:
            if file.read(4) != b"\x7fELF":
                continue
            own.add(path.name)
            dynamic: Any = next(ELFFile(file).iter_segments("PT_DYNAMIC"), None)
            for tag in dynamic.iter_tags() if dynamic is not None else ():
                if tag.entry.d_tag == "DT_NEEDED":
                    wanted[tag.needed].append(path.relative_to(folder).as_posix())
                elif tag.entry.d_tag == "DT_SONAME":
                    own.add(tag.soname)
    return len(own), {name: users for name, users in sorted(wanted.items()) if name not in own}


def missing_libraries(wanted: dict[str, list[str]], *, here: bool = False) -> dict[str, list[str]]:
    """Libraries that are missing on a minimal Debian plus packages.txt; with `here`, also those missing here."""
    system_libraries = {name: users for name, users in wanted.items() if name not in NEVER_LOADED}
    return {
        name: users
        for name, users in system_libraries.items()
        if (name not in ALWAYS and OTHER_NAMES.get(name, name) not in PACKAGE_OF) or (here and not loads(name))
    }


def main() -> None:
    """Print needed and missing libraries; fail if any is missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--here", action="store_true")
    here = parser.parse_args().here
    count, wanted = needed_libraries(Path(sysconfig.get_path("platlib")))
    missing = missing_libraries(wanted, here=here)
    for name, users in wanted.items():
        package = PACKAGE_OF.get(OTHER_NAMES.get(name, name), "every Debian")
        owner = "MISSING" if name in missing else NEVER_LOADED.get(name, package)
        print(f"{name:32s}{owner:40s} {users[0]}" + (f" and {len(users) - 1} more" if users[1:] else ""))
    print("RESULT " + json.dumps({"objects": count, "of_the_system": len(wanted), "nowhere": sorted(missing)}))
    sys.exit(bool(missing))


if __name__ == "__main__":
    main()
