"""Toolbox for tests: returns the mean grey level of an image; dies, hangs or fails at certain levels."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes.models import ModelInfo
from scan2sim.services.toolboxes.results import Body, Class
from scan2sim.services.toolboxes.settings import ToolboxParams as Params
from scan2sim.services.toolboxes.tasks import PostProcessor

NEEDS = ()
DIES, HANGS, FAILS, RAISES, SLOW = 201, 202, 203, 204, 205
HANGS_FILE = "SHAKY_HANGS_FILE"
"""Environment variable with the path of a file that is created when the model begins to hang."""

__all__ = ["NEEDS", "Params", "check", "draw", "image", "level_of", "load", "post_processor"]


def image(level: int, shape: tuple[int, int] = (8, 8)) -> U8:
    return np.full((*shape, 3), level, np.uint8)


def level_of(body: Body | None) -> int:
    assert body and body.classes
    return int(body.classes[0].label)


class _Model:
    info = ModelInfo("shaky", ("level",), "0" * 64, "none")

    def __call__(self, images: Sequence[U8]) -> list[Body]:
        return [self._one(one) for one in images]

    def _one(self, seen: U8) -> Body:
        level = int(seen.mean())
        if level == DIES:
            os._exit(3)
        if level == HANGS:
            if HANGS_FILE in os.environ:
                Path(os.environ[HANGS_FILE]).touch()
            time.sleep(3600)
        if level == FAILS:
            raise StepError("shaky", "can't", "Don't")
        if level == RAISES:
            raise RuntimeError("oh")
        if level == SLOW:
            time.sleep(0.1)
        return Body(classes=(Class(label=str(level), score=1),))


def check(params: Params) -> None:
    pass


def load(params: Params) -> _Model:
    return _Model()


def post_processor(params: Params) -> PostProcessor | None:
    return None


def draw(image: U8, body: Body) -> U8:
    return image
