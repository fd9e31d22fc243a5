"""Kinds of input: ROS bags in all formats, with a lidar, a camera and transforms."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from scan2sim.flows.pipelines.bag import BagSource, build_graph
from scan2sim.pipeline.importers.bag.plan import BagParams
from scan2sim.pipeline.importers.bag.unpack import unpack
from tests.fakes.bags import bag_path
from tests.pipeline.importers.bag.test_unpack import write


def bag(form: str) -> tuple[Callable[[Path], list[Path]], Callable[[Path], object]]:
    """Writer and reader of a bag."""

    def make(folder: Path) -> list[Path]:
        path = write(bag_path(folder, form), form)
        return [path] if path.is_file() else sorted(path.iterdir())

    def read(folder: Path) -> object:
        path, out = bag_path(folder, form), folder / "out"
        shutil.rmtree(out, ignore_errors=True)
        return build_graph(BagSource(file=path), folder), unpack(path, out, BagParams())

    return make, read
