"""A changed photo: the world equals one built from scratch, and geometry is kept where its inputs are the same."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scan2sim.pipeline.core.cache import Manifest, read_manifest
from tests.flows.inline_steps import inline_steps
from tests.flows.tiny import COARSE, scan2sim, tiny

SETTINGS = COARSE | {"backdrop": {"when": "never"}}


def run(tile: Path, out: Path) -> None:
    """Build the world of a tile, with all steps in this process."""
    with inline_steps():
        code, printed = scan2sim("run", tile, "--out", out, settings=SETTINGS)
    assert code == 0, printed


def change(photo: Path) -> None:
    """Replace a photo by a darker one."""
    picture = cv2.imread(str(photo))
    assert picture is not None
    cv2.imwrite(str(photo), np.asarray(picture * 0.8, np.uint8))


def results(out: Path) -> dict[str, tuple[str, int]]:
    """Content of each result, and the inode of one of its files, which a reused result keeps."""
    found = {}
    for path in (out / "steps").glob("*/*/manifest.json"):
        manifest = read_manifest(path)
        assert manifest is not None
        file = min(manifest.sizes, default=None)
        found[manifest.label] = (manifest.content, (path.parent / file).lstat().st_ino if file else 0)
    return found


def test_result_equals_a_run_from_scratch_and_geometry_is_not_computed_again(
    small_street: Path, tmp_path: Path
) -> None:
    tile = tiny(small_street, tmp_path / "tile", photos=4)
    run(tile, tmp_path / "out")
    before = results(tmp_path / "out")
    change(sorted((tile / "photos").glob("*.jpg"))[0])
    run(tile, tmp_path / "out")
    run(tile, tmp_path / "scratch")
    after, scratch = results(tmp_path / "out"), results(tmp_path / "scratch")
    assert {task: content for task, (content, _) in after.items()} == {
        task: content for task, (content, _) in scratch.items()
    }
    kept = {task.split(".")[0] for task in after if after[task][1] == before[task][1]}
    assert {"segment", "split", "voxel", "poisson", "trim", "islands", "decimate"} <= kept
    assert after["texture.terrain"][0] != before["texture.terrain"][0]


def test_content_of_an_output_ignores_other_outputs_but_not_what_belongs_to_none() -> None:
    files = {"cameras": "cameras.json", "views": "views"}

    def made(**changed: str) -> Manifest:
        digests = {"cameras.json": "1", "views/a.jpg": "2", "shared.txt": "3"} | {
            name.replace("__", "/").replace("_", "."): digest for name, digest in changed.items()
        }
        sizes = dict.fromkeys(digests, 1)
        return Manifest("views", 1, {}, {}, "", "", files, sizes, digests, {}, [], 0.0, 0.0)

    cameras, own = made().content_of("cameras"), made().content_of("views")
    other_photo = made(views__a_jpg="4")
    assert other_photo.content_of("cameras") == cameras and other_photo.content_of("views") != own
    assert made(shared_txt="4").content_of("cameras") != cameras
