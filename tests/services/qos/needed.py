"""Skips tests where no emulated link can be created."""

from __future__ import annotations

import os
import shutil

import pytest

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.services.qos import links


def need_link(backend: str | None = None, *programs: str) -> None:
    """Skip the test if no emulated link can be created here, or a program is missing."""
    if os.geteuid() != 0:
        pytest.skip("only root may create network namespaces")
    try:
        links.find(backend)
    except UnavailableError as error:
        pytest.skip(str(error))
    if missing := [name for name in programs if not shutil.which(name)]:
        pytest.skip(f"no {', '.join(missing)} here (tests/services/packages.txt)")
