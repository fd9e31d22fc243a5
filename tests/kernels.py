"""`python -m tests.kernels`: compile numba's kernels once, by making tiny worlds and a panorama of a synthetic drive.

Otherwise several processes of tests would each compile them, for minutes.
"""

from __future__ import annotations

import multiprocessing
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
COMPILED = "*/*/__pycache__/*.nbi"
"""Index files of compiled kernels."""


def are_compiled() -> bool:
    """Whether there are compiled kernels in this checkout."""
    return any(ROOT.glob(COMPILED))


def main() -> None:
    """Make the world of a tiny street and that of its two tiles, and at the same time render a panorama."""
    panorama = multiprocessing.get_context("spawn").Process(target=render_panorama)
    panorama.start()
    make_worlds()
    panorama.join()


def render_panorama() -> None:
    """Render one frame of a synthetic drive, whose kernels no step of a world uses."""
    from scan2sim.data_samples import paths
    from scan2sim.data_samples.panorama import Panorama
    from scan2sim.data_samples.town import build
    from scan2sim.data_samples.traffic import Traffic

    path = paths.loop_path(width=70.0, depth=60.0, laps=1.2)
    drive = paths.drive(path, 10.0, 15.0, seed=3)
    panorama = Panorama(build(path, seed=3), Traffic(path, drive, 3), 16, seed=3, radius=90.0)
    panorama.render(drive.poses[20], float(drive.times[20]))


def make_worlds() -> None:
    """Make the world of a tiny street with everything that is optional, then that of a survey, which has borders."""
    from scan2sim.data_samples.street import generate
    from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey
    from tests.flows.tiny import COARSE, scan2sim, tiny

    with tempfile.TemporaryDirectory(prefix="scan2sim-kernels-") as folder:
        street, tile, survey = (Path(folder) / name for name in ("street", "tile", "survey"))
        generate(street, length=12.0, points=150_000, photos=8, seed=5, photo_width=480)
        tiny(street, tile, photos=4)
        plain = COARSE | {"split": {"vegetation": "both"}}
        optional = plain | {"navigation": {"when": "always"}, "splats": {"when": "auto", "epochs": [1, 0, 0]}}
        cut_survey(tile, survey, CutParams(length=6.0, buffer=3.0))
        for command, settings in (
            (("run", tile, "--out", Path(folder) / "out", "--hold-out", 4), optional),
            (("survey", survey, "--out", Path(folder) / "survey_out"), plain),
        ):
            code, printed = scan2sim(*command, settings=settings)
            if code:
                raise SystemExit(printed)


if __name__ == "__main__":
    main()
