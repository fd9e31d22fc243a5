"""The key shared by an onboard unit and its vehicle adapter, without which an adapter obeys nobody.

`teleop certificates` writes it into the folder of each vehicle.
"""

from __future__ import annotations

import os
import secrets
import stat
from pathlib import Path

from scan2sim.pipeline.core.errors import InputError, SettingError

ADAPTER_KEY_FILE = "adapter.key"
"""Name of the key's file in a vehicle's folder."""
KEY_BYTES, KEY_MIN_BYTES = 32, 16
"""Length of a new key, and minimum length of any."""
_REMEDY = "`scan2sim teleop certificates DIR --vehicle NAME` writes one for both: DIR/vehicle-NAME/adapter.key"


def create(path: Path) -> Path:
    """Write a new key, readable by its user only, unless the file exists; returns its path.

    Raises:
        OSError: it can't be written.
    """
    if not path.exists():
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(secrets.token_hex(KEY_BYTES) + "\n")
    return path


def require(path: Path | None) -> Path:
    """The key's file.

    Raises:
        SettingError: none is given.
    """
    if path is None:
        cause = "is missing: any program of this machine could drive the vehicle through an adapter without a key"
        raise SettingError("--key", cause, f"Give the same file to onboard unit and adapter. {_REMEDY}")
    return path


def read(path: Path | None) -> bytes:
    """Read the key.

    Raises:
        SettingError: no file is given.
        InputError: the file can't be read, other users can read it, or the key is too short.
    """
    path = require(path)
    try:
        key, mode = path.read_bytes().strip(), stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise InputError(path, str(error.strerror), _REMEDY) from None
    if mode & 0o077:
        raise InputError(path, f"is accessible to other users (mode {mode:o})", f"chmod 600 {path}")
    if len(key) < KEY_MIN_BYTES:
        cause = f"contains a key of only {len(key)} bytes; at least {KEY_MIN_BYTES} are needed"
        raise InputError(path, cause, _REMEDY)
    return key
