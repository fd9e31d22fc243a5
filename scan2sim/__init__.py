"""scan2sim: street scans to textured, lightweight worlds for robot simulators.

The packages are folders at the top of the repository. Links here (in the wheel: the folders themselves) give them one
name, `scan2sim.<package>`, in a checkout and installed, whatever else is called `pipeline` or `flows` on a user's path.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from scan2sim.pipeline.core import kernel_cache

if TYPE_CHECKING:
    from scan2sim.flows.api import (
        BusyError,
        Camera,
        DataError,
        IncompleteError,
        InputError,
        LowConfidenceError,
        ScanError,
        SettingError,
        SpaceError,
        StepError,
        UnavailableError,
        World,
        camera,
        export,
        import_bag,
        import_clouds,
        import_images,
        import_kitti_odometry,
        import_kitti_raw,
        import_map,
        import_nuscenes,
        import_pandaset,
        import_photogrammetry,
        import_sweeps,
        read_world,
        run,
        survey,
    )

kernel_cache.choose()  # before numba is imported
__version__ = "0.1.0"
__all__ = [
    "BusyError",
    "Camera",
    "DataError",
    "IncompleteError",
    "InputError",
    "LowConfidenceError",
    "ScanError",
    "SettingError",
    "SpaceError",
    "StepError",
    "UnavailableError",
    "World",
    "__version__",
    "camera",
    "export",
    "import_bag",
    "import_clouds",
    "import_images",
    "import_kitti_odometry",
    "import_kitti_raw",
    "import_map",
    "import_nuscenes",
    "import_pandaset",
    "import_photogrammetry",
    "import_sweeps",
    "read_world",
    "run",
    "survey",
]


def __getattr__(name: str) -> Any:
    """Load the API when it is first used: `import scan2sim` alone stays quick."""
    if name in __all__:
        return getattr(import_module("scan2sim.flows.api"), name)
    raise AttributeError(f"module 'scan2sim' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Names for completion in shells and notebooks: those that are loaded when they are first used, too."""
    return sorted({*globals(), *__all__})
