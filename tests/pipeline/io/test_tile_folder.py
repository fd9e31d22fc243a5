"""Output folders of importers: what happens to a folder that exists, and to links into it."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.io.tile_folder import MARKER_FILE, add_file, tile_folder


def create(out: Path, content: str = "new", *, overwrite: bool = False) -> None:
    with tile_folder(out, overwrite) as folder:
        (folder / MARKER_FILE["tile"]).write_text(content, encoding="utf-8")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_current_folder_stays_the_users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tile").mkdir()
    monkeypatch.chdir(tmp_path / "tile")
    for content in ("first", "second"):
        create(Path(), content, overwrite=True)
        assert names(Path()) == ["tile.toml"] and names(tmp_path) == ["tile"]
        assert Path("tile.toml").read_text(encoding="utf-8") == content


def test_a_mounted_disk_gets_the_tile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk, rename = tmp_path / "disk", Path.replace
    disk.mkdir()

    def refuse(path: Path, target: Path) -> Path:
        if disk in (path, target):
            raise OSError(errno.EBUSY, "Device or resource busy")
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", refuse)
    monkeypatch.setattr(Path, "is_mount", lambda path: path == disk)
    create(disk)
    assert names(disk) == ["tile.toml"] and names(tmp_path) == ["disk"]


def test_a_link_to_a_folder_leads_to_the_tile(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "tile").symlink_to(tmp_path / "disk")
    create(tmp_path / "tile")
    assert names(tmp_path / "disk") == ["tile.toml"] and (tmp_path / "tile").is_symlink()


def test_files_that_the_new_tile_links_to_are_not_deleted(tmp_path: Path) -> None:
    tile = tmp_path / "tile"
    create(tile)
    (tile / "cloud.laz").write_bytes(b"points")
    with pytest.raises(SettingError, match="would be lost"), tile_folder(tile, overwrite=True) as folder:
        add_file(tile / "cloud.laz", folder, "cloud.laz", link=True)
    assert (tile / "cloud.laz").read_bytes() == b"points" and names(tmp_path) == ["tile"]


@pytest.mark.parametrize(("umask", "mode"), [(0o077, 0o700), (0o022, 0o755), (0o002, 0o775)])
def test_tiles_and_results_have_the_permissions_that_the_user_chose(umask: int, mode: int, tmp_path: Path) -> None:
    before = os.umask(umask)
    try:
        create(tmp_path / "tile")
        result = Store(tmp_path / "steps").begin("trim")
    finally:
        os.umask(before)
    assert [folder.stat().st_mode & 0o777 for folder in (tmp_path / "tile", result)] == [mode, mode]


def test_file_names_of_another_encoding_are_reported(tmp_path: Path) -> None:
    photo = tmp_path / os.fsdecode("straße.jpg".encode("latin-1"))
    photo.write_bytes(b"photo")
    with pytest.raises(InputError, match=r"stra\\udcdfe.jpg: has a name that isn't UTF-8"):
        add_file(photo, tmp_path / "tile", f"photos/{photo.name}")


def test_folders_with_long_names_can_be_created(tmp_path: Path) -> None:
    create(tmp_path / ("ä" * 120))
    assert names(tmp_path) == ["ä" * 120]
