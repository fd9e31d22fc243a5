"""Backends that shape the traffic of a link, one module each (`pipeline.core.plugins`)."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.plugins import Unavailable
from scan2sim.services.qos.link_profile import LinkProfile
from scan2sim.services.qos.namespaces import FEATURE, Namespace


class Wire(Protocol):
    """A connected link."""

    def shape(self, there: LinkProfile, back: LinkProfile) -> None:
        """Set the profiles of packets from the near side and back to it."""


class Backend(Protocol):
    """Interface of a backend module.

    Attributes:
        RANK: preference; the lowest is the best.
    """

    RANK: int

    def unavailable(self) -> Unavailable | None:
        """Why it can't run here; None if it can."""

    def connect(self, near: Namespace, far: Namespace, folder: Path, wire: int) -> Wire:
        """Create and connect both interfaces of a wire; files of its programs are written to the folder."""


def find(name: str | None = None) -> Backend:
    """A backend that can run here: the named one, or the best.

    Raises:
        SettingError: unknown name.
        UnavailableError: it can't run here, or none can.
    """
    found: Backend = plugins.best(__name__, name, "link", FEATURE)
    return found


def programs(**packages: str) -> Unavailable | None:
    """`Backend.unavailable` for required programs, given with the Debian packages that provide them."""
    missing = [name for name in packages if shutil.which(name) is None]
    if not missing:
        return None
    debian_packages = " ".join(sorted({packages[name] for name in missing}))
    return Unavailable(f"needs {', '.join(missing)}, not installed here", f"apt-get install {debian_packages}")
