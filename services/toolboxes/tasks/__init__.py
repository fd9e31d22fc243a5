"""Toolboxes behind one protocol: a file each, found by its name; what they share is in `services.toolboxes`."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.results import Body
from scan2sim.services.toolboxes.settings import ToolboxParams


@dataclass(frozen=True)
class Facts:
    """What is known of a model.

    Attributes:
        name: of its architecture or file.
        labels: names of its classes.
        sha256: of the weights' file.
        licence: of the weights, as far as the file or its package says.
    """

    name: str
    labels: tuple[str, ...]
    sha256: str
    licence: str


class Model(Protocol):
    """A model that is loaded."""

    facts: Facts

    def __call__(self, images: Sequence[U8], /) -> list[Body]:
        """What it says of each image (H, W, 3) uint8 RGB, of any size; several at once may be cheaper."""


Follow = Callable[[Frame, U8, Body], Body]
"""What is done with the results of one source, in order: from a frame, its image and what the model said of it."""


class Toolbox(Protocol):
    """What a toolbox's module has."""

    Params: type[ToolboxParams]

    def check(self, params: Any) -> None:
        """Refuse settings that it can't run with here; nothing heavy is loaded.

        Raises:
            ScanError: a package or the weights are missing, or aren't what they should be.
        """

    def load(self, params: Any) -> Model:
        """The model; called in the process that runs it.

        Raises:
            ScanError: it can't run here, or its weights aren't what they should be.
        """

    def follow(self, params: Any) -> Follow | None:
        """For one source; None: a model's results are the toolbox's."""

    def draw(self, image: U8, body: Body) -> U8:
        """An image with what was said of it drawn on it."""


def names() -> list[str]:
    """Of all toolboxes."""
    return plugins.names(__name__)


def find(name: str) -> Toolbox:
    """A toolbox that can run here; a name with dots is a module of the user's own that has what `Toolbox` lists.

    Raises:
        SettingError: there is none of that name.
        UnavailableError: a package is missing.
    """
    if "." in name:
        return _module(name)
    found: Toolbox = plugins.find(__name__, name, "toolbox")
    return found


def _module(name: str) -> Toolbox:
    try:
        found: Toolbox = importlib.import_module(name)
    except ImportError as error:
        raise SettingError("toolbox", f"{name!r} can't be imported ({error})", "Put it on PYTHONPATH") from None
    return found
