"""Disks that are mounted on this machine: kind and options of the one that holds a path."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

MOUNTED = Path("/proc/self/mountinfo")
NETWORK = (
    *("nfs", "nfs4", "cifs", "smb3", "lustre", "gpfs", "beegfs", "ceph", "9p", "afs"),
    *("fuse.sshfs", "fuse.glusterfs", "fuse.ceph-fuse", "fuse.s3fs", "fuse.gcsfuse", "fuse.juicefs"),
)
"""File systems that other machines may write to at the same time."""


@dataclass(frozen=True)
class Mount:
    """A mounted disk.

    Attributes:
        kind: type of its file system (`nfs4`).
        options: as the file system reports them (`local_lock`: `none`); those without a value have an empty one.
    """

    kind: str
    options: dict[str, str]

    @property
    def is_network(self) -> bool:
        """Whether other machines may write to it at the same time."""
        return self.kind in NETWORK


def mount_of(path: Path, mounted: Path = MOUNTED) -> Mount | None:
    """The disk that holds a path, which may not exist yet; None if the system doesn't list its disks.

    Args:
        path: a file or folder.
        mounted: the kernel's list of mounted disks (proc_pid_mountinfo(5)).
    """
    try:
        lines = mounted.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError:
        return None
    path, found, longest = path.resolve(), None, -1
    for line in lines:
        about, _, file_system = line.partition(" - ")
        if len(about.split()) < 5 or len(file_system.split()) < 3:
            continue
        place = Path(re.sub(r"\\(\d{3})", lambda code: chr(int(code[1], 8)), about.split()[4]))
        if path.is_relative_to(place) and len(place.parts) >= longest:  # a later one covers an earlier one
            kind, _, options = file_system.split()[:3]
            pairs = (option.partition("=") for option in options.split(","))
            found, longest = Mount(kind, {name: value for name, _, value in pairs}), len(place.parts)
    return found
