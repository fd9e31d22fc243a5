"""usage: exp_splats.py STREET NAME [change=json ...]"""
import sys, json
from dataclasses import replace
from pathlib import Path
import numpy as np, cv2
from bench.street import splat_ablation as ab
from scan2sim.texturing.splats import step
from scan2sim.texturing.splats import shots as shots_mod
from scan2sim.texturing.backdrop.photos import FARTHEST_M
street, name, *changes = sys.argv[1:]
change = {c.split("=",1)[0]: json.loads(c.split("=",1)[1]) for c in changes}
stereo = change.pop("x.stereo", None)
if stereo is not None:
    from scan2sim.texturing.splats import depth as depth_mod, training
    original = step._begun
    def begun(used, excluded, seen, params, state, report):
        kept = {}
        def keep(photo, others):
            good = depth_cons(photo, others); kept[photo.view.name] = (photo, good); return good
        depth_cons = depth_mod.consistent
        depth_mod.consistent = keep
        try:
            made = original(used, excluded, seen, params, state, report)
        finally:
            depth_mod.consistent = depth_cons
        for i, shot in enumerate(seen):
            photo, good = kept[shot.name]
            h, w = shot.inverse.shape
            inv = np.where(good & ~np.isfinite(photo.known) & (photo.inverse > 1/FARTHEST_M), photo.inverse, 0).astype(np.float32)
            dist = np.where(inv > 0, 1/np.maximum(inv,1e-6), np.inf).astype(np.float32)
            add = shots_mod._resized_inverse(dist, w, h)
            print(shot.name, "known", (shot.inverse>0).mean().round(3), "added", ((shot.inverse==0)&(add>0)).mean().round(3))
            seen[i] = replace(shot, inverse=np.where(shot.inverse > 0, shot.inverse, add))
        return made
    step._begun = begun
worlds, out = Path("/work/wt/splatbench/bench-out/street"), Path("/tmp/exp")
rows_file = out / "rows.json"; out.mkdir(exist_ok=True)
found = ab.row(street, worlds, out / f"{name}_{street}", change)
rows = json.loads(rows_file.read_text()) if rows_file.is_file() else {}
rows.setdefault(name, {})[street] = found
rows_file.write_text(json.dumps(rows, indent=1))
print("EXP", name, street, {k: (round(v,3) if isinstance(v,float) else v) for k, v in found.items() if k in ab.METRICS})
