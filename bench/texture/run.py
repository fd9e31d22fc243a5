"""Our textures compared with common baselines, on one mesh, one atlas and one set of photos.

`python -m bench.texture [--scenes kitti street_clean street_hard] [--methods open3d nearest inverse_square ours]
[--out bench-out/texture] [--pictures DIR] [--keep]`

Scenes (`bench.texture.scenes`) are created if missing: a KITTI street (skipped without its data), and a generated one
without and with exposure changes and a moving car. Methods run one after another, each in separate processes;
held-out photos are compared with each method's rendering on the pixels textured by the method.

- Seconds and GB of ours are those of the steps visibility; exposure, photo_consistency, view_selection and unwrap;
  texture: three processes including imports (sum of seconds, maximum of memory). The baselines nearest and
  inverse_square are given atlas and depth maps; Open3D is given the atlas, but time_ratio and memory_ratio add xatlas'
  plain unwrapping of the whole mesh to its albedo projection.
- truth (streets): PSNR against the true surface colours where a photo saw them within 15 m, without and with one gain
  per channel for the whole street. truth_psnr_db of RESULT is street_clean's without gain, truth_hard_psnr_db
  street_hard's with gain, as photos with unknown exposure don't determine the overall brightness.
- ghosts (street_hard): see `bench.texture.truth.Road`; needs street_clean by the same method.
- *_over_best_db: mean PSNR (with gain) at the held-out photos, ours minus the best baseline's; street: street_hard.

Ends with `RESULT {json}`; null for scenes or methods that were not run.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bench.measure import Measurement, measure
from bench.paths import ROOT
from bench.texture.scenes import KITTI, SCENES, WARM_UP, Scene, available, fresh, make, run
from scan2sim.pipeline.core.sandbox import die_with_parent
from scan2sim.pipeline.steps.visibility import VISIBILITY
from scan2sim.texturing.exposure import EXPOSURE
from scan2sim.texturing.photo_consistency import PHOTO_CONSISTENCY
from scan2sim.texturing.texture import TEXTURE
from scan2sim.texturing.unwrap import UNWRAP
from scan2sim.texturing.view_selection.step import VIEW_SELECTION

METHODS = ("open3d", "nearest", "inverse_square", "ours")
METRICS = ("psnr_db", "psnr_gain_db", "ssim", "sharpness", "coverage")


def visibility(scene: Scene, out: Path) -> None:
    """Depth maps of ours, used by all methods except Open3D's."""
    run(VISIBILITY, {"mesh.surface": scene.mesh, "views": scene.views} | scene.clouds, out)


def unwrap(scene: Scene, out: Path) -> None:
    """Atlas of ours, used by all methods; its charts are cut by the photos chosen by ours."""
    files = {"mesh": scene.mesh, "views": scene.views, "depth": scene.depth}
    for step in (EXPOSURE, PHOTO_CONSISTENCY, VIEW_SELECTION):
        files |= run(step, files, scene.folder / "choice" / step.name)
    run(UNWRAP, files, out)


def ours(scene: Scene, out: Path) -> None:
    """Texture of ours with the default settings of the step `texture`."""
    choice = scene.folder / "choice"
    inputs = {
        "mesh": scene.atlas / "mesh.npz",
        "pages": scene.atlas / "pages.json",
        "views": scene.views,
        "depth": scene.depth,
        "exposures": choice / "exposure" / "exposures.json",
        "photo_consistency": choice / "photo_consistency" / "photo_consistency",
        "choice": choice / "view_selection" / "choice.npz",
    }
    files = run(TEXTURE, inputs | scene.clouds, out / "steps")
    for file in files["textured"].iterdir():
        file.rename(out / file.name)


def work(method: str, scene: Scene, out: Path) -> None:
    """Task of a child process: create a scene or a part of it, or a method's texture."""
    die_with_parent()
    if method in ("unwrap", "visibility", "ours"):
        globals()[method](scene, out)
    elif method == "make":
        make(scene.folder.name, scene)
    else:
        from bench.texture import baselines

        getattr(baselines, method)(scene, out)


@dataclass
class Row:
    """Results of a method in a scene.

    Attributes:
        measured: time and memory.
        photos: metrics (`METRICS`) by held-out photo.
        more: metrics of truth and ghosts, for the streets.
    """

    measured: Measurement
    photos: dict[str, dict[str, float]] = field(default_factory=dict)
    more: dict[str, float] = field(default_factory=dict)

    def mean(self, figure: str) -> float:
        """Mean over the photos."""
        values = [photo[figure] for photo in self.photos.values()]
        return sum(values) / len(values) if values else float("nan")


class Bench:
    """A run of the benchmark: scenes below `out`, methods one after another.

    Args:
        keep: reuse results of an earlier run, except for ours.
    """

    def __init__(self, out: Path, methods: Sequence[str], *, keep: bool, pictures: Path | None) -> None:
        self.out, self.methods, self.keep, self.pictures = out, methods, keep, pictures

    def scene(self, name: str) -> Scene:
        """The scene of that name, created if missing."""
        scene = Scene(self.out / name)
        if not scene.views.is_file():
            if name == "street_hard":
                self.scene("street_clean")
            self._child("make", scene, scene.folder)
        return scene

    def folder(self, scene: Scene, method: str) -> Path:
        """Folder of a method's texture of a scene."""
        return scene.folder / "methods" / method

    def textures(self, scene: Scene) -> dict[str, Row]:
        """Run the methods; time and memory of each."""
        prepared = [self._shared(scene, "visibility", scene.depth.parent), self._shared(scene, "unwrap", scene.atlas)]
        rows = {}
        for method in self.methods:
            mine = self._run(scene, method, again=method == "ours")
            parts = [*prepared, mine] if method == "ours" else [mine]
            rows[method] = Row(_total(parts))
        return rows

    def _shared(self, scene: Scene, step: str, folder: Path) -> Measurement:
        """Atlas or depth maps: computed once per run, or only once if ours isn't run."""
        note = scene.folder / f"{step}.json"
        if "ours" in self.methods or not note.is_file():
            note.write_text(json.dumps(asdict(self._child(step, scene, fresh(folder)))), encoding="utf-8")
        return Measurement(**json.loads(note.read_text(encoding="utf-8")))

    def _run(self, scene: Scene, method: str, *, again: bool) -> Measurement:
        folder = self.folder(scene, method)
        note = folder.with_suffix(".json")
        if again or not (self.keep and note.is_file()):
            note.unlink(missing_ok=True)
            measured = self._child(method, scene, fresh(folder))
            note.write_text(json.dumps(asdict(measured)), encoding="utf-8")
        return Measurement(**json.loads(note.read_text(encoding="utf-8")))

    def parametrize(self, scene: Scene) -> Measurement:
        """Plain unwrapping of the whole mesh by xatlas."""
        return self._run(scene, "parametrize", again=False)

    def _child(self, method: str, scene: Scene, out: Path) -> Measurement:
        command = [sys.executable, "-m", "bench.texture", "--method", method]
        measured = measure([*command, "--scene", str(scene.folder), "--out", str(out)])
        if measured.status != 0:
            sys.exit(f"{method} of {scene.folder.name} failed with exit status {measured.status}")
        print(f"  {scene.folder.name} {method}: {measured.seconds:.1f} s, {measured.peak_gb:.2f} GB", flush=True)
        return measured

    def score(self, scene: Scene, rows: dict[str, Row]) -> None:
        """Compare renderings with the held-out photos."""
        from scan2sim.pipeline.camera.renderer import Renderer, textured
        from scan2sim.texturing.evaluate import held_out

        held = scene.photos(held_out=True)
        depths = [scene.depth / f"{i}.npy" for i in held]
        shown: dict[str, list[Any]] = {}
        for method, row in rows.items():
            for result in held_out(Renderer([textured(self.folder(scene, method))]), list(held.values()), depths):
                name = Path(result.view.name).name
                row.photos[name] = {figure: getattr(result, figure, float("nan")) for figure in METRICS}
                shown.setdefault(name, [("photo", result.photo)]).append(
                    (method, np.where(result.render.hit[..., None], result.render.rgb, np.uint8(255)))
                )
        if self.pictures is not None:
            from tests.fakes.world_checks.side_by_side import side_by_side

            for name, images in shown.items():
                side_by_side(self.pictures, f"{scene.folder.name}_{name}", images)

    def score_truth(self, scene: Scene, rows: dict[str, Row]) -> None:
        """Compare textures with the true surface colours, and print the PSNR of the photos themselves."""
        from bench.texture.truth import likeness, samples, truth_psnr

        truth = samples(scene)
        ceiling = likeness(truth.photo, truth.rgb.astype(np.float32))
        print(
            f"{scene.folder.name}: {len(truth.xyz):,} true samples seen within 15 m; PSNR of the nearest photo itself: "
            f"{ceiling[0]:.2f} dB, with gain {ceiling[1]:.2f} dB (upper bound)"
        )
        for method, row in rows.items():
            figures = truth_psnr(self.folder(scene, method), truth)
            row.more |= dict(zip(("truth_db", "truth_gain_db", "truth_coverage"), figures, strict=True))

    def score_ghosts(self, clean: Scene, hard: Scene, rows: dict[str, Row]) -> None:
        """Count ghost texels on the road of the street with the moving car."""
        from bench.texture.truth import Road

        road = Road(clean, hard)
        print(f"street_hard: {road.avoidable:,} road texels where a photo shows the car and three see the road")
        for method, row in rows.items():
            picture = None if self.pictures is None else self.pictures / f"road_{method}.png"
            count, painted = road.ghosts(self.folder(clean, method), self.folder(hard, method), picture)
            row.more |= {"ghosts": count, "ghost_painted": painted}


def _total(parts: Sequence[Measurement]) -> Measurement:
    return Measurement(sum(p.seconds for p in parts), max(p.peak_gb for p in parts), 0)


def table(name: str, rows: dict[str, Row]) -> str:
    """Table of a scene's results, a row per method."""
    more = list(dict.fromkeys(key for row in rows.values() for key in row.more))
    heads = ["PSNR", "gain", "SSIM", "sharp", "cover", *more, "s", "GB"]
    widths = [max(8, len(head) + 2) for head in heads]
    lines = ["", f"{name:<16}" + "".join(f"{head:>{w}}" for head, w in zip(heads, widths, strict=True))]
    for method, row in rows.items():
        values = [f"{row.mean(f):.2f}" for f in METRICS[:2]] + [f"{row.mean(f):.3f}" for f in METRICS[2:]]
        values += [f"{row.more[key]:,.0f}" if key == "ghosts" else f"{row.more[key]:.2f}" for key in more]
        values += [f"{row.measured.seconds:.1f}", f"{row.measured.peak_gb:.2f}"]
        lines.append(f"{method:<16}" + "".join(f"{value:>{w}}" for value, w in zip(values, widths, strict=True)))
    for method, row in rows.items():
        each = ", ".join(f"{photo} {f['psnr_db']:.1f} ({f['psnr_gain_db']:.1f})" for photo, f in row.photos.items())
        lines.append(f"  {method}: {each}")
    return "\n".join(lines)


def over_best(rows: dict[str, Row]) -> float | None:
    """PSNR in dB of ours above the best baseline, with gain; None without both."""
    others = [row.mean("psnr_gain_db") for method, row in rows.items() if method != "ours"]
    return rows["ours"].mean("psnr_gain_db") - max(others) if others and "ours" in rows else None


def result(tables: dict[str, dict[str, Row]], parametrize: Measurement | None) -> dict[str, float | None]:
    """Values of the RESULT line."""
    kitti, clean, hard = (tables.get(name, {}) for name in SCENES)
    mine, theirs = kitti.get("ours"), kitti.get("open3d")
    out: dict[str, float | None] = {
        "kitti_psnr_db": mine.mean("psnr_gain_db") if mine else None,
        "kitti_ssim": mine.mean("ssim") if mine else None,
        "kitti_sharpness": mine.mean("sharpness") if mine else None,
        "kitti_over_best_db": over_best(kitti),
        "street_over_best_db": over_best(hard),
        "truth_psnr_db": clean["ours"].more["truth_db"] if "ours" in clean else None,
        "truth_hard_psnr_db": hard["ours"].more["truth_gain_db"] if "ours" in hard else None,
        "ghost_texels": hard["ours"].more.get("ghosts") if "ours" in hard else None,
        "time_ratio": None,
        "memory_ratio": None,
    }
    if mine and theirs and parametrize:
        whole = _total([parametrize, theirs.measured])
        out["time_ratio"] = whole.seconds / mine.measured.seconds
        out["memory_ratio"] = mine.measured.peak_gb / whole.peak_gb
    return {key: None if value is None or value != value else round(value, 3) for key, value in out.items()}


def main() -> None:
    """Create scenes, run methods, print a table per scene and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=[*SCENES, WARM_UP], default=list(SCENES))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "texture")
    parser.add_argument("--pictures", type=Path, help="folder for images of photo and renderings side by side")
    parser.add_argument("--keep", action="store_true", help="reuse results of an earlier run, except for ours")
    parser.add_argument("--method", help=argparse.SUPPRESS)  # in a child process: the one to run,
    parser.add_argument("--scene", type=Path, help=argparse.SUPPRESS)  # and its scene
    arguments = parser.parse_args()
    if arguments.method:
        work(arguments.method, Scene(arguments.scene), arguments.out)
        return
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
    tables, parametrize = _run(
        Bench(arguments.out, arguments.methods, keep=arguments.keep, pictures=arguments.pictures), arguments.scenes
    )
    print("RESULT " + json.dumps(result(tables, parametrize)))


def _run(bench: Bench, scenes: Sequence[str]) -> tuple[dict[str, dict[str, Row]], Measurement | None]:
    """Tables of the scenes, printed as they are computed, and cost of xatlas' plain unwrapping of KITTI's mesh."""
    tables: dict[str, dict[str, Row]] = {}
    parametrize = None
    others = [method for method in bench.methods if method != "open3d"]
    print("warming up: compiling kernels, which happens only once per machine")
    warm = Bench(bench.out, others, keep=False, pictures=None)
    warm.textures(warm.scene(WARM_UP))
    for name in scenes:
        if not available(name):
            print(f"{name}: skipped, {KITTI} doesn't exist")
            continue
        scene = bench.scene(name)
        rows = tables[name] = bench.textures(scene)
        if name == "kitti" and "open3d" in rows:
            parametrize = bench.parametrize(scene)
        bench.score(scene, rows)
        if name.startswith("street"):
            bench.score_truth(scene, rows)
        if name == "street_hard" and "street_clean" in tables:
            bench.score_ghosts(Scene(bench.out / "street_clean"), scene, rows)
        print(table(name, rows), flush=True)
    return tables, parametrize
