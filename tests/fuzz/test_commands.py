"""Commands with damaged files: exit code, error message without traceback, existing results unchanged."""

from __future__ import annotations

import hashlib
from pathlib import Path
from random import Random

import pytest

from tests.flows.command import in_process
from tests.fuzz.damage import damaged
from tests.fuzz.harness import VALID_CODES
from tests.fuzz.kinds import KINDS
from tests.pipeline.io.test_tile import body, cloud, save

SEEDS = range(12)
COMMANDS = {
    "laz": ["import", "clouds", "{x}/c.laz", "--crs", "EPSG:32632"],
    "photos.csv": ["import", "clouds", "{x}/c.laz", "--photos", "{x}/photos.csv", "--cameras", "{x}/cameras.csv"],
    "colmap bin": ["import", "colmap", "{x}/bin", "{x}/images"],
    "kitti raw": ["import", "kitti-raw", "{x}/2011_09_26"],
    "sweeps": [
        "import", "sweeps", "{x}/sweeps", "{x}/camera.csv", "--extrinsics", "{x}/extrinsics.txt",
        "--photos", "{x}/photos",
    ],
    "survey.toml": ["survey", "{x}"],
    "tile.toml": ["run", "{x}"],
}  # fmt: skip


def contents(folder: Path) -> dict[str, str]:
    """Digests of all files below a folder, except logs and locks."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix not in (".log", ".lock"))
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def earlier_results(folder: Path) -> Path:
    """Create a folder with a tile, a survey.toml and results of an earlier run."""
    folder.mkdir()
    save(folder, body(folder, photos=[], cameras=[]))
    (folder / "survey.toml").write_text("# earlier", encoding="utf-8")
    for name in ("world/town.sdf", "world/models/town/model.sdf", "report.html", "steps/ingest/k/manifest.json"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("earlier", encoding="utf-8")
    return folder


@pytest.mark.parametrize("kind", COMMANDS)
def test_a_damaged_file_is_reported_and_existing_results_are_kept(kind: str, tmp_path: Path) -> None:
    """Tries the first two damages that the reader rejects."""
    x, out = tmp_path / "x", earlier_results(tmp_path / "out")
    x.mkdir()
    files, before, rejected = KINDS[kind].make(x), contents(out), 0
    for seed in SEEDS:
        rng = Random(seed)
        path = rng.choice(files)
        good = path.read_bytes()
        path.write_bytes(damaged(good, rng))
        try:
            KINDS[kind].read(x)
        except Exception:
            arguments = [argument.format(x=x) for argument in COMMANDS[kind]]
            overwrite = ["--overwrite"] if "import" in arguments else []
            done = in_process(*arguments, "--out", out, *overwrite)
            assert done.returncode in VALID_CODES - {0}, done.stderr
            assert "error: " in done.stderr and "Traceback" not in done.stderr
            assert contents(out) | before == contents(out), f"seed {seed}"
            rejected += 1
        path.write_bytes(good)
        if rejected == 2:
            return
    raise AssertionError(f"only {rejected} of {len(SEEDS)} damages are rejected")


def test_a_run_that_fails_midway_keeps_the_earlier_world(tmp_path: Path) -> None:
    """The tile is valid, but has too few points, which is detected only when they are read."""
    out = earlier_results(tmp_path / "out")
    before = {name: digest for name, digest in contents(out).items() if not name.startswith("steps")}
    (tmp_path / "tile").mkdir()
    save(tmp_path / "tile", body(tmp_path / "tile", photos=[], cameras=[]))
    cloud(tmp_path / "tile" / "cloud.laz", n=500)
    done = in_process("run", tmp_path / "tile", "--out", out)
    assert done.returncode == 4 and "only 500 points" in done.stderr and "Traceback" not in done.stderr
    assert contents(out) | before == contents(out)
