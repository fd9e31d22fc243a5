"""Backends and formats: a file each, found by its name in its package; each says what it needs to run here.

To add one: a file in the package. It has what the package's protocol asks for, and, where that takes more than the
project's own dependencies, `NEEDS`, their import names. Files are formats by `SUFFIXES`, ends of their names.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

from scan2sim.pipeline import extras
from scan2sim.pipeline.errors import SettingError


def names(package: str) -> list[str]:
    """Of all backends in a package, ascending."""
    return sorted(module.name for module in pkgutil.iter_modules(importlib.import_module(package).__path__))


def module(package: str, name: str) -> Any:
    """The module of a backend, one of `names`."""
    return importlib.import_module(f"{package}.{name}")


def missing(package: str, name: str) -> str | None:
    """Packages that a backend can't run here without, as "torch, safetensors"; None: it can."""
    return extras.missing(*needs(module(package, name)))


def needs(backend: Any) -> tuple[str, ...]:
    """Import names of the packages that a backend needs."""
    named: tuple[str, ...] = getattr(backend, "NEEDS", ())
    return named


def find(package: str, name: str, setting: str) -> Any:
    """The module of a backend that can run here; only what its file imports is loaded.

    Args:
        package: its full name.
        name: of the backend, as the user gave it.
        setting: that named it, for errors.

    Raises:
        SettingError: there is no such backend.
        UnavailableError: it can't run here.
    """
    known = names(package)
    if name not in known:
        raise SettingError(setting, f"there is no {name!r}", f"Choose one of: {', '.join(known)}")
    backend = module(package, name)
    extras.need(f"{setting} {name}", *needs(backend))
    return backend


def by_suffix(package: str) -> dict[str, str]:
    """Ends of files' names to the formats in a package that read them."""
    return {suffix: name for name in names(package) for suffix in module(package, name).SUFFIXES}
