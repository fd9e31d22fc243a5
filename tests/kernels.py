"""`python -m tests.kernels`: compile numba's kernels once, by making a tiny world.

Otherwise several processes of tests would each compile them, for minutes.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
COMPILED = "*/*/__pycache__/*.nbi"
"""Index files of compiled kernels."""


def are_compiled() -> bool:
    """Whether there are compiled kernels in this checkout."""
    return any(ROOT.glob(COMPILED))


def main() -> None:
    """Make the world of a tiny street."""
    from scan2sim.data_samples.street import generate
    from tests.flows.tiny import COARSE, scan2sim, tiny

    with tempfile.TemporaryDirectory(prefix="scan2sim-kernels-") as folder:
        street, tile = Path(folder) / "street", Path(folder) / "tile"
        generate(street, length=12.0, points=150_000, photos=8, seed=5, photo_width=480)
        tiny(street, tile, photos=4)
        settings = COARSE | {"split": {"vegetation": "both"}}
        code, printed = scan2sim("run", tile, "--out", Path(folder) / "out", "--hold-out", 4, settings=settings)
        if code:
            raise SystemExit(printed)


if __name__ == "__main__":
    main()
