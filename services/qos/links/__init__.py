"""What shapes a link: a file each, found by its name (`pipeline.core.plugins`)."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.plugins import Lacking
from scan2sim.services.qos.link_profile import Shape
from scan2sim.services.qos.namespaces import WHAT, Namespace


class Wire(Protocol):
    """A link that is there."""

    def shape(self, there: Shape, back: Shape) -> None:
        """Do so from now on, to packets from the near side and to it."""


class Backend(Protocol):
    """What a file here has.

    Attributes:
        RANK: the lower, the better is what it makes.
    """

    RANK: int

    def lacking(self) -> Lacking | None:
        """What isn't there; None: it can run here."""

    def connect(self, near: Namespace, far: Namespace, folder: Path, wire: int) -> Wire:
        """Make both interfaces of a wire, and join them; programs' files go to the folder."""


def find(name: str | None = None) -> Backend:
    """A backend that can run here: of that name, or the best.

    Raises:
        SettingError: there is none of that name.
        UnavailableError: it can't run here, or none can.
    """
    found: Backend = plugins.best(__name__, name, "link", WHAT)
    return found


def programs(**packages: str) -> Lacking | None:
    """`Backend.lacking` of programs, given with the Debian packages that bring them."""
    absent = [name for name in packages if shutil.which(name) is None]
    if not absent:
        return None
    wanted = " ".join(sorted({packages[name] for name in absent}))
    return Lacking(f"needs {', '.join(absent)}, not installed here", f"apt-get install {wanted}")
