"""Results and sources in object storage: a real S3 server, and machines that share nothing else."""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Iterator
from multiprocessing import forkserver
from pathlib import Path

import pytest

from scan2sim.flows.engine.execution import execute
from scan2sim.flows.engine.planning import plan
from scan2sim.pipeline.core import remote
from scan2sim.pipeline.core.cache import Store
from scan2sim.pipeline.core.errors import InputError, SpaceError, UnavailableError
from scan2sim.pipeline.core.remote import CACHE_VARIABLE, Remote, is_remote, local_copy
from tests.flows.toy import chain


def test_a_user_without_a_cache_folder_is_told_how_to_choose_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "file" / "cache"))
    with pytest.raises(UnavailableError, match=f"s3://survey/town: can't be copied.*Set {CACHE_VARIABLE}"):
        Remote.of("s3://survey/town")


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """The URL of an empty bucket."""
    server = pytest.importorskip("moto.server").ThreadedMotoServer(port=0)
    pytest.importorskip("s3fs")
    server.start()
    host, port = server.get_host_and_port()
    environment = {"AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x"}
    environment |= {"AWS_DEFAULT_REGION": "us-east-1"}
    before = dict(os.environ)
    os.environ.update(environment)
    forkserver._forkserver._stop()  # type: ignore[attr-defined]  # nodes have the environment that it was started with
    import s3fs

    s3fs.S3FileSystem(endpoint_url=environment["AWS_ENDPOINT_URL"]).mkdir("survey", create_parents=True)
    yield "s3://survey"
    os.environ.clear()
    os.environ.update(before)
    server.stop()


def test_remote_path_has_a_local_copy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    assert not is_remote(tmp_path) and local_copy(tmp_path) == tmp_path
    assert is_remote("s3://a/b") and local_copy("s3://a/b/").parent == tmp_path
    assert local_copy("s3://a/b") == local_copy("s3://a/b/") != local_copy("s3://c/b")


def test_another_machine_continues_the_run(s3: str, tmp_path: Path) -> None:
    (tmp_path / "source.txt").write_text("1", encoding="utf-8")
    log = tmp_path / "log"

    def machine(name: str, **changes: dict[str, object]) -> dict[str, object]:
        store = Store(tmp_path / name, Remote(f"{s3}/steps", tmp_path / name))
        tasks = chain(tmp_path / "source.txt", log, **changes)
        outcome = execute(plan(tasks, store), store, jobs=1, on_event=lambda *_: None, keep_going=True)
        return {name: manifest.metrics["total"] for name, manifest in outcome.of_tile().items()}

    assert set(machine("first", c={"does": "fail"})) == {"a", "b"}
    assert sorted(log.read_text(encoding="utf-8").split()) == ["a", "b", "c"]
    assert machine("second") == {"a": 1, "b": 1, "c": 1, "d": 2}
    assert sorted(log.read_text(encoding="utf-8").split()) == ["a", "b", "c", "c", "d"]
    assert machine("third") == {"a": 1, "b": 1, "c": 1, "d": 2}  # only manifests are fetched
    assert not list((tmp_path / "third").rglob("number.txt"))


def test_local_copy_follows_the_remote_file(s3: str, tmp_path: Path) -> None:
    here, there = Remote(f"{s3}/tiles", tmp_path / "here"), Remote(f"{s3}/tiles", tmp_path / "there")
    (here.local / "a").mkdir(parents=True)
    (here.local / "a" / "one.txt").write_text("1", encoding="utf-8")
    (here.local / "two.txt").write_text("2", encoding="utf-8")
    here.push_all(["a/one.txt", "two.txt"])
    assert there.pull_all() == tmp_path / "there"
    assert (there.local / "a" / "one.txt").read_text(encoding="utf-8") == "1" and (there.local / "two.txt").read_text(
        encoding="utf-8"
    ) == "2"
    untouched = (there.local / "two.txt").stat().st_mtime_ns
    (here.local / "a" / "one.txt").write_text("11", encoding="utf-8")
    here.push_all(["a/one.txt", "two.txt"])
    there.pull_all()
    assert (there.local / "a" / "one.txt").read_text(encoding="utf-8") == "11"
    assert (there.local / "two.txt").stat().st_mtime_ns == untouched


def test_remote_source_is_fetched(s3: str, tmp_path: Path) -> None:
    first, second = Remote(f"{s3}/src", tmp_path / "a"), Remote(f"{s3}/src", tmp_path / "b")
    first.local.mkdir()
    (first.local / "cloud.laz").write_text("points", encoding="utf-8")
    first.push(["cloud.laz"])
    store = Store(tmp_path / "steps", sources=second)
    assert store.source(second.local / "cloud.laz").read_text(encoding="utf-8") == "points"


def test_machine_with_an_older_copy_of_a_source_fetches_the_new_one(tmp_path: Path) -> None:
    files = pytest.importorskip("fsspec").filesystem("memory")
    remote = Remote("memory://daily", tmp_path / "cache")
    store, cloud = Store(tmp_path / "steps", sources=remote), remote.local / "cloud.laz"
    files.pipe_file("/daily/cloud.laz", b"Monday")
    assert store.source(cloud).read_bytes() == b"Monday"
    files.pipe_file("/daily/cloud.laz", b"Tuesday")
    planned = hashlib.sha256(b"Tuesday").hexdigest()
    assert store.source(cloud, planned).read_bytes() == b"Tuesday"
    files.pipe_file("/daily/cloud.laz", b"half of Wedn")
    cloud.unlink()
    with pytest.raises(InputError, match=r"memory://daily/cloud.laz: has changed during the run"):
        store.source(cloud, planned)


def test_damaged_local_copy_is_fetched_and_damaged_remote_result_rebuilt(s3: str, tmp_path: Path) -> None:
    (tmp_path / "source.txt").write_text("1", encoding="utf-8")
    log, remote = tmp_path / "log", Remote(f"{s3}/damaged", tmp_path / "here")

    def machine(**changes: dict[str, object]) -> list[str]:
        store = Store(tmp_path / "here", remote)
        log.unlink(missing_ok=True)
        execute(plan(chain(tmp_path / "source.txt", log, **changes), store), store, jobs=1, on_event=lambda *_: None)
        return sorted(log.read_text(encoding="utf-8").split())

    assert machine() == ["a", "b", "c", "d"]
    (number,) = (tmp_path / "here" / "a").rglob("number.txt")
    number.write_text("7", encoding="utf-8")
    assert machine(b={"value": 5}) == ["b", "d"] and number.read_text(encoding="utf-8") == "1"
    number.write_text("7", encoding="utf-8")
    remote.push([number.relative_to(remote.local).as_posix()])
    assert machine(b={"value": 6}) == ["a", "b", "d"] and number.read_text(encoding="utf-8") == "1"


def test_key_with_path_traversal_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """S3 allows such keys, as does fsspec's memory storage."""
    files = pytest.importorskip("fsspec").filesystem("memory")
    here = Remote("memory://survey", tmp_path / "cache" / "here")
    files.pipe_file("/survey/tile.toml", b"a tile")
    assert (here.pull_all() / "tile.toml").read_bytes() == b"a tile"
    for key in ("../escaped.txt", "a/../../../escaped.txt", "/etc/escaped.txt", "link/escaped.txt"):
        monkeypatch.setattr(type(files), "find", lambda *_, key=key: [f"/survey/{key}"])
        files.store[f"/survey/{key}"] = files.store["/survey/tile.toml"]
        if "link" in key:
            (here.local / "link").symlink_to(tmp_path)
        with pytest.raises(InputError, match="points outside of its folder"):
            here.pull_all()
        with pytest.raises(InputError, match="points outside of its folder"):
            here.pull([key])
    assert not list(tmp_path.rglob("escaped.txt")) and not Path("/etc/escaped.txt").exists()


def test_objects_that_mark_folders_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As "Create folder" of AWS's console makes them."""
    files = pytest.importorskip("fsspec").filesystem("memory")
    here = Remote("memory://marked", tmp_path / "cache")
    files.pipe_file("/marked/tile/cloud.laz", b"points")
    keys = ["/marked/", "/marked/tile/", "/marked/tile/cloud.laz"]
    monkeypatch.setattr(type(files), "find", lambda *_: keys)
    assert (here.pull_all() / "tile" / "cloud.laz").read_bytes() == b"points"
    keys.pop()
    with pytest.raises(InputError, match="is empty"):
        here.pull_all()


def test_killed_download_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = pytest.importorskip("fsspec").filesystem("memory")
    here, fetched = Remote("memory://kilometres", tmp_path / "cache"), list[str]()
    for i in range(4):
        files.pipe_file(f"/kilometres/{i}.laz", b"points")
    get = type(files).get_file

    def killed_at_the_third(self: object, source: str, *arguments: object, **options: object) -> None:
        if len(fetched) == 2:
            raise KeyboardInterrupt
        fetched.append(source)
        get(self, source, *arguments, **options)

    monkeypatch.setattr(remote, "INDEX_INTERVAL_S", -1.0)
    with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
        killed.setattr(type(files), "get_file", killed_at_the_third)
        here.pull_all()
    fetched *= 2  # no more kills
    monkeypatch.setattr(type(files), "get_file", killed_at_the_third)
    here.pull_all()
    assert [source.rpartition("/")[2] for source in fetched[4:]] == ["2.laz", "3.laz"]
    (here.local / ".remote.json").write_text('{"0.la', encoding="utf-8")
    assert (here.pull_all() / "3.laz").read_bytes() == b"points", "a damaged index is made again"


def test_full_disk_of_the_local_copy_is_not_taken_for_the_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = pytest.importorskip("fsspec").filesystem("memory")
    here = Remote("memory://full", tmp_path / "cache")
    files.pipe_file("/full/cloud.laz", b"points")

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as disk:
        disk.setattr(type(files), "get_file", full)
        with pytest.raises(SpaceError, match=f"{tmp_path / 'cache'}: no space left"):
            here.pull(["cloud.laz"])
    monkeypatch.setattr(Path, "mkdir", full)
    with pytest.raises(SpaceError, match="no space left"):
        here.pull(["new/cloud.laz"])


def test_missing_or_unreadable_remote_files_are_reported(s3: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is empty"):
        Remote(f"{s3}/nothing", tmp_path).pull_all()
    with pytest.raises(UnavailableError, match="fsspec"):
        Remote("nosuch://bucket/x", tmp_path).pull_all()
    assert not Remote(f"{s3}/nothing", tmp_path).pull(["manifest.json"])
