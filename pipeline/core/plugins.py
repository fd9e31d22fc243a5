"""Backends and formats: a file each, found by its name in its package; each says what it needs to run here.

To add one: a file in the package. It has what the package's protocol asks for, and, where that takes more than the
project's own dependencies, `NEEDS`, their import names (`EXTRA`: what brings them, where several extras do). Files are
formats by `SUFFIXES`, ends of their names. Where one of several is chosen unasked, `RANK` says which are better, and
`lacking()` what of the machine isn't there.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any, NamedTuple

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import SettingError, UnavailableError


def names(package: str) -> list[str]:
    """Of all backends in a package, ascending."""
    return sorted(module.name for module in pkgutil.iter_modules(importlib.import_module(package).__path__))


def module(package: str, name: str) -> Any:
    """The module of a backend, one of `names`."""
    return importlib.import_module(f"{package}.{name}")


def missing(package: str, name: str) -> str | None:
    """Packages that a backend can't run here without, as "torch, safetensors"; None: it can."""
    return optional_deps.missing(*needs(module(package, name)))


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
    optional_deps.need(f"{setting} {name}", *needs(backend), extra=_extra(backend))
    return backend


def _extra(backend: Any) -> str:
    named: str = getattr(backend, "EXTRA", "")
    return named


class Lacking(NamedTuple):
    """Why a backend can't run here, and what to do about it."""

    cause: str
    remedy: str


def best(package: str, name: str | None, setting: str, what: str) -> Any:
    """The module of a backend that can run here: of that name, or the one of least `RANK`.

    Args:
        package: its full name.
        name: of the backend, as the user gave it; None: the best.
        setting: that named it, for errors.
        what: needs one, for errors.

    Raises:
        SettingError: there is no such backend.
        UnavailableError: it can't run here, or none can.
    """
    asked = [find(package, name, setting)] if name else [module(package, one) for one in names(package)]
    why = {}
    for backend in sorted(asked, key=lambda one: one.RANK):
        lacking = _lacking(backend)
        if lacking is None:
            return backend
        why[backend.__name__.rpartition(".")[2]] = lacking
    causes = "; ".join(f"{one} {lacking.cause}" for one, lacking in why.items())
    raise UnavailableError(what, causes, " or ".join(dict.fromkeys(lacking.remedy for lacking in why.values())))


def _lacking(backend: Any) -> Lacking | None:
    packages = optional_deps.missing(*needs(backend))
    if packages:
        error = optional_deps.unavailable(backend.__name__, packages, extra=_extra(backend))
        return Lacking(error.cause, error.remedy)
    lacking: Lacking | None = backend.lacking()
    return lacking


def by_suffix(package: str) -> dict[str, str]:
    """Ends of files' names to the formats in a package that read them."""
    return {suffix: name for name in names(package) for suffix in module(package, name).SUFFIXES}
