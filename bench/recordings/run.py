"""Recordings: worlds' inputs made by importers, compared with references.

`python -m bench.recordings [--parts bags mistakes ins passes strips photos surveys long_bag]
[--out bench-out/recordings]`

- bags: a KITTI raw drive (of the folder that SCAN2SIM_REAL_DATA gives) and a synthetic drive are written as MCAP,
  SQLite and ROS 1 bags, and imported; `bags_differ`: imports whose cloud, photos, cameras or poses differ from those of
  the recording's own importer by more than 1 mm, or in number, of all `bags`. `bags_pose_mm`: largest difference of
  poses; `bags_points_identical`: least share of points with identical stored coordinates (whole millimetres).
- mistakes: usual mistakes in poses, cameras and times, injected into a synthetic and three real recordings:
  `mistakes_named` with the option that fixes them, of all `mistakes`; `mistakes_false`: named in correct recordings.
- ins: KITTI raw drives with OXTS poses; `ins_gap_db`: largest gap in PSNR against held-out photos between the world
  made with sweep-matched poses and that of `import kitti-raw` alone. Four worlds: many minutes.
- passes: a synthetic drive of two passes whose INS drifts; `passes_gap_cm`: largest distance between their surfaces.
- strips: an assembled cloud of a synthetic street, two passes whose INS drifts; `strips_gap_cm`: largest distance
  between their surfaces after `import clouds --trajectory`.
- photos: photos without poses and a cloud by `import images`: `photos_pose_m`, `photos_turn_deg` against truth.
- surveys (only if selected): every real drive cut into tiles of 12 m; `surveys_failed`: surveys without a world of all
  their tiles, of all `surveys`.
- long_bag (only if selected): memory and time of imports of 24 million points with images, and of an hour without.

To add a part, write a module with `measure(out: Path) -> dict`, and list it in `PARTS`. A part whose recording or
package is missing fails with the reason; its figures are null, and the exit status is 1. Ends with `RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.maps.command import Missing
from bench.paths import ROOT
from bench.recordings import bags, ins, long_bag, mistakes, passes, photos, strips, surveys

PARTS: dict[str, tuple[Callable[[Path], dict[str, Any]], tuple[str, ...]]] = {
    "bags": (bags.measure, ("bags_differ", "bags")),
    "mistakes": (mistakes.measure, ("mistakes_named", "mistakes_false")),
    "ins": (ins.measure, ("ins_gap_db",)),
    "passes": (passes.measure, ("passes_gap_cm",)),
    "strips": (strips.measure, ("strips_gap_cm", "strips_unchanged")),
    "photos": (photos.measure, ("photos_pose_m", "photos_turn_deg", "photos_mistakes")),
    "surveys": (surveys.measure, ("surveys_failed", "surveys")),
    "long_bag": (long_bag.measure, ("long_bag_peak_gb",)),
}
"""Part: its function, and the figures that are null if it fails or isn't run."""
SELECTED_ONLY = ("surveys", "long_bag")
"""Parts that run only if they are named."""


def main() -> None:
    """Run the parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--parts", nargs="+", choices=PARTS, default=[name for name in PARTS if name not in SELECTED_ONLY]
    )
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "recordings")
    arguments = parser.parse_args()
    result: dict[str, Any] = {key: None for _, keys in PARTS.values() for key in keys}
    failed: dict[str, str] = {}
    for name in arguments.parts:
        try:
            result |= PARTS[name][0](arguments.out.resolve() / name)
        except Missing as error:
            failed[name] = str(error)
            print(f"PART {name} FAILED: {error}", flush=True)
    print("RESULT " + json.dumps(result | {"failed_parts": failed}))
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
