"""Kind and options of the disk that holds a path."""

from __future__ import annotations

from pathlib import Path

import pytest

from scan2sim.pipeline.core.mounts import Mount, mount_of

MOUNTED = """22 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw,errors=remount-ro
40 22 0:44 / /nowhere/home rw,relatime shared:9 - nfs4 server:/home rw,vers=4.2,hard,local_lock=none,addr=10.0.0.1
41 22 0:45 / /nowhere/my\\040scratch rw shared:10 master:1 - lustre 10.0.0.2@tcp:/scratch rw,flock,lazystatfs
42 40 8:2 / /nowhere/home/local rw - xfs /dev/sdb1 rw
"""


@pytest.mark.parametrize(
    ("path", "kind", "network"),
    [
        ("/nowhere/data", "ext4", False),
        ("/nowhere/home/me/.prefect/prefect.db", "nfs4", True),
        ("/nowhere/homes", "ext4", False),
        ("/nowhere/my scratch/town", "lustre", True),
        ("/nowhere/home/local/town", "xfs", False),
    ],
)
def test_the_innermost_disk_holds_a_path(path: str, kind: str, network: bool, tmp_path: Path) -> None:
    (tmp_path / "mountinfo").write_text(MOUNTED, encoding="utf-8")
    mount = mount_of(Path(path), tmp_path / "mountinfo")
    assert mount is not None and (mount.kind, mount.is_network) == (kind, network)


def test_options_and_systems_without_a_list(tmp_path: Path) -> None:
    (tmp_path / "mountinfo").write_text(MOUNTED, encoding="utf-8")
    mount = mount_of(Path("/nowhere/home"), tmp_path / "mountinfo")
    assert isinstance(mount, Mount) and (mount.options["local_lock"], mount.options["hard"]) == ("none", "")
    assert mount_of(Path("/"), tmp_path / "nothing") is None
