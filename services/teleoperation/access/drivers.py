"""Named drivers of a station or gateway: credentials and roles, in a file that is read again whenever it changes.

Each driver has a token, of which the file holds the SHA-256 only. A driver who is removed from the file loses control
at once; if the file can't be read, so does everybody.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import threading
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Protocol

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from scan2sim.pipeline.core.errors import InputError, SettingError, from_os_error
from scan2sim.services.teleoperation.gateway_protocol import NAME_PATTERN


class AccessError(SettingError):
    """A driver whose role doesn't include the one that an action requires."""


LOGIN_MAX_CHARS = 200
TOKEN_BYTES = 32
"""Random bytes of a driver's token."""


class DriverRole(StrEnum):
    """What a driver may do; each role includes those before it."""

    OBSERVER = "observer"
    """Watch, and press the emergency stop."""
    DRIVER = "driver"
    """Drive."""
    OPERATOR = "operator"
    """Join and release vehicles."""

    def includes(self, role: DriverRole) -> bool:
        """Whether it includes another role."""
        return list(DriverRole).index(self) >= list(DriverRole).index(role)


class Driver(BaseModel):
    """A driver.

    Attributes:
        token_sha256: SHA-256 of the token, hexadecimal; None: no token, the driver signs in at a provider.
        login: who the driver is at the provider (`oidc`), such as an e-mail address; None: the driver has a token.
        expires: when token or login expires; None: never.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(pattern=f"^{NAME_PATTERN.pattern}$")]
    role: DriverRole
    token_sha256: Annotated[str | None, Field(pattern="^[0-9a-f]{64}$")] = None
    login: Annotated[str | None, Field(min_length=1, max_length=LOGIN_MAX_CHARS)] = None
    expires: AwareDatetime | None = None

    def is_valid(self) -> bool:
        """Whether token or login has not expired."""
        return self.expires is None or datetime.now(UTC) < self.expires

    def require(self, role: DriverRole) -> None:
        """Check the driver's role.

        Raises:
            AccessError: it doesn't include this one.
        """
        if not self.role.includes(role):
            cause = f"has the role {self.role}; this requires {role}"
            raise AccessError(self.name, cause, "Ask whoever manages the drivers (`teleop drivers`)")


_FILE = TypeAdapter(tuple[Driver, ...])


def read(path: Path) -> tuple[Driver, ...]:
    """Read the drivers of a file.

    Raises:
        InputError: the file can't be read or is not valid.
    """
    remedy = "`scan2sim teleop drivers FILE --add NAME` writes it"
    try:
        return _FILE.validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(path, str(error.strerror), remedy) from None
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(path, f"{'.'.join(map(str, first['loc']))}: {first['msg']}", remedy) from None


def add(path: Path, name: str, role: DriverRole, expires: datetime | None = None, login: str | None = None) -> str:
    """Add a driver, or give an existing one a new token and role; returns the token, which is stored nowhere.

    With `login`, who the driver is at an OpenID provider, the driver has no token, and "" is returned.

    Raises:
        SettingError: the name or login is not valid, or another driver has this login.
        InputError: the file exists and is not valid.
        SpaceError: it can't be written.
    """
    if not NAME_PATTERN.fullmatch(name):
        raise SettingError("--add", f"{name!r} is not a valid name", "Use letters, digits, dots, hyphens; at most 60")
    others = [one for one in (read(path) if path.exists() else ()) if one.name != name]
    token = "" if login is not None else secrets.token_hex(TOKEN_BYTES)
    if login is not None:
        _check_login(login, others)
    digest = _digest(token) if token else None
    _write(path, [*others, Driver(name=name, role=role, token_sha256=digest, login=login, expires=expires)])
    return token


def _check_login(login: str, others: list[Driver]) -> None:
    if not 0 < len(login) <= LOGIN_MAX_CHARS or login != login.strip() or not login.isprintable():
        cause = f"{login[:60]!r} is not a valid login"
        raise SettingError("--login", cause, "Give the value of the provider's claim, such as anna@example.org")
    if (other := next((one.name for one in others if one.login == login), None)) is not None:
        raise SettingError("--login", f"is that of {other}", "Revoke that driver first, or give another login")


def revoke(path: Path, name: str) -> None:
    """Remove a driver, who loses control at once.

    Raises:
        InputError: the file can't be read.
        SettingError: there is no such driver.
        SpaceError: the file can't be written.
    """
    drivers = read(path)
    if name not in [one.name for one in drivers]:
        raise SettingError("--revoke", f"{path} has no driver {name!r}", "`teleop drivers FILE` lists them")
    _write(path, [one for one in drivers if one.name != name])


def _write(path: Path, drivers: list[Driver]) -> None:
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(_FILE.dump_json(tuple(drivers), indent=1))
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise from_os_error(error, path) from None


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


class Access(Protocol):
    """Who may use a page."""

    def identify(self, token: str) -> Driver | None:
        """The driver of a token; None: nobody's, revoked or expired."""


@dataclass
class Drivers:
    """The drivers of a file, as it is now; thread-safe.

    Raises:
        InputError: the file is not valid at first.
    """

    path: Path

    def __post_init__(self) -> None:
        self._lock, self._read, self._drivers = threading.Lock(), self._version(), read(self.path)

    def identify(self, token: str) -> Driver | None:
        """The driver of a token; None: nobody's, revoked or expired."""
        digest = _digest(token)
        found = next((o for o in self._current() if secrets.compare_digest(o.token_sha256 or "", digest)), None)
        return found if found is not None and found.is_valid() else None

    def of_login(self, login: str) -> Driver | None:
        """The driver with a login at a provider; None: nobody's, revoked or expired."""
        found = next((one for one in self._current() if one.login == login), None)
        return found if found is not None and found.is_valid() else None

    def _current(self) -> tuple[Driver, ...]:
        with self._lock:
            if (version := self._version()) != self._read:
                try:
                    self._drivers = read(self.path)
                except InputError:
                    self._drivers = ()  # nobody, rather than those of the past
                self._read = version
            return self._drivers

    def _version(self) -> tuple[int, int, int]:
        try:
            found = self.path.stat()
        except OSError:
            return 0, 0, 0
        return found.st_mtime_ns, found.st_size, found.st_ino
