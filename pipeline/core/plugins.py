"""Plugins: backends and file formats, one module each, found by module name in their package.

To add one, add a module to the package. It implements the package's protocol. Attributes: `NEEDS`, import names of
optional packages that it requires (`EXTRA`: the extra that installs them, if several do); `SUFFIXES`, endings of file
names that a format handles. If the best available backend is chosen automatically: `RANK`, lowest is best, and
`unavailable()`, the reason why it can't run on this machine.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any, NamedTuple

from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.errors import SettingError, UnavailableError


def names(package: str) -> list[str]:
    """Names of all backends in a package, sorted."""
    return sorted(module.name for module in pkgutil.iter_modules(importlib.import_module(package).__path__))


def module(package: str, name: str) -> Any:
    """The module of a backend, one of `names`."""
    return importlib.import_module(f"{package}.{name}")


def missing(package: str, name: str) -> str | None:
    """Missing packages that a backend requires, as "torch, safetensors"; None if all are installed."""
    return optional_deps.missing(*needs(module(package, name)))


def needs(backend: Any) -> tuple[str, ...]:
    """Import names of the packages that a backend needs."""
    packages: tuple[str, ...] = getattr(backend, "NEEDS", ())
    return packages


def find(package: str, name: str, setting: str) -> Any:
    """Load the module of a backend and check that the packages it requires are installed.

    Args:
        package: full name of the package of backends.
        name: name of the backend, as given by the user.
        setting: name of the setting, for error messages.

    Raises:
        SettingError: there is no such backend.
        UnavailableError: packages that it requires are missing.
    """
    known = names(package)
    if name not in known:
        raise SettingError(setting, f"unknown value {name!r}", f"Choose one of: {', '.join(known)}")
    backend = module(package, name)
    optional_deps.require(f"{setting} {name}", *needs(backend), extra=_extra(backend))
    return backend


def _extra(backend: Any) -> str:
    extra: str = getattr(backend, "EXTRA", "")
    return extra


class Unavailable(NamedTuple):
    """Why a backend can't run on this machine, and the remedy."""

    cause: str
    remedy: str


def best(package: str, name: str | None, setting: str, what: str) -> Any:
    """Load a backend that can run on this machine: the named one, or the available one with the lowest `RANK`.

    Args:
        package: full name of the package of backends.
        name: name of the backend, as given by the user; None: the best available.
        setting: name of the setting, for error messages.
        what: what needs a backend, for error messages.

    Raises:
        SettingError: there is no such backend.
        UnavailableError: the named one can't run on this machine, or none can.
    """
    candidates = [find(package, name, setting)] if name else [module(package, one) for one in names(package)]
    reasons = {}
    for backend in sorted(candidates, key=lambda one: one.RANK):
        reason = _unavailable(backend)
        if reason is None:
            return backend
        reasons[backend.__name__.rpartition(".")[2]] = reason
    causes = "; ".join(f"{one} {reason.cause}" for one, reason in reasons.items())
    raise UnavailableError(what, causes, " or ".join(dict.fromkeys(reason.remedy for reason in reasons.values())))


def _unavailable(backend: Any) -> Unavailable | None:
    packages = optional_deps.missing(*needs(backend))
    if packages:
        error = optional_deps.unavailable(backend.__name__, packages, extra=_extra(backend))
        return Unavailable(error.cause, error.remedy)
    reason: Unavailable | None = backend.unavailable()
    return reason


def by_suffix(package: str) -> dict[str, str]:
    """Map file name endings to the formats in a package that read them."""
    return {suffix: name for name in names(package) for suffix in module(package, name).SUFFIXES}
