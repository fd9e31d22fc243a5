"""Plugins of the toolboxes, one module per task, found by name; the shared code is in `services.toolboxes`."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.models import ModelInfo
from scan2sim.services.toolboxes.results import Body
from scan2sim.services.toolboxes.settings import ToolboxParams


class Model(Protocol):
    """A loaded model."""

    info: ModelInfo

    def __call__(self, images: Sequence[U8], /) -> list[Body]:
        """Run the model on images (H, W, 3) uint8 RGB of any size; a batch may be faster than single images."""


PostProcessor = Callable[[Frame, U8, Body], Body]
"""Processes the results of one source in order: from a frame, its decoded image and the model's output."""


class Toolbox(Protocol):
    """Interface of a toolbox's module."""

    Params: type[ToolboxParams]

    def check(self, params: Any) -> None:
        """Check that the toolbox can run here with these settings, without loading the model.

        Raises:
            ScanError: a package or the weights are missing or invalid.
        """

    def load(self, params: Any) -> Model:
        """Load the model; called in the process that runs it.

        Raises:
            ScanError: it can't run here, or its weights are invalid.
        """

    def post_processor(self, params: Any) -> PostProcessor | None:
        """Create the post-processor of one source; None: the model's output is the final result."""

    def draw(self, image: U8, body: Body) -> U8:
        """Draw a result on a copy of an image."""


def names() -> list[str]:
    """Names of all toolboxes."""
    return plugins.names(__name__)


def find(name: str) -> Toolbox:
    """Find a toolbox by name; a name with dots is a user-defined module that implements `Toolbox`.

    Raises:
        SettingError: unknown name.
        UnavailableError: a required package isn't installed.
    """
    if "." in name:
        return _module(name)
    found: Toolbox = plugins.find(__name__, name, "toolbox")
    return found


def _module(name: str) -> Toolbox:
    try:
        found: Toolbox = importlib.import_module(name)
    except ImportError as error:
        cause = f"the module {name!r} can't be imported ({error})"
        raise SettingError("toolbox", cause, "Check the name and PYTHONPATH") from None
    return found
