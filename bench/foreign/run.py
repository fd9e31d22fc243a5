"""Inputs as other programs write them: read right, named in a warning, or rejected with the true reason.

`python -m bench.foreign [--kinds 2 3] [--cases NAME] [--out bench-out/foreign]`

Each case (`bench/foreign/cases`) writes files with known content, and runs a command on them in a process of its own.
- `inputs`: number of cases. `silent`: wrong results, or results that need a warning, without one. `crashed`: a
  traceback, a signal, or no end. `rejected_valid`: rejected, though valid.
- `untrue`: errors and warnings of which no reader has judged that cause and remedy are true (`judged.json`: the message
  without figures and paths, and true or false). `--out` gets `messages.json`, with those that aren't judged.
- `false_alarms`: findings about plausibility (`scan2sim inspect`) in the real recordings of SCAN2SIM_REAL_DATA and in
  the samples; null without recordings.

Ends with `RESULT {json}`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from bench.foreign import cases
from bench.foreign.alarms import false_alarms
from bench.foreign.case import KINDS, Case, Outcome, run
from bench.paths import ROOT
from scan2sim.pipeline.core import plugins

JUDGED = Path(__file__).with_name("judged.json")
WORKERS = 2
BAD = ("silent", "crashed", "rejected_valid")


def main() -> None:
    """Run the cases and print what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", type=int, choices=KINDS, metavar="N", help=f"only these: {KINDS}")
    parser.add_argument("--cases", nargs="+", help="only cases with these names")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "foreign")
    arguments = parser.parse_args()
    chosen = [
        one
        for one in every_case()
        if (not arguments.kinds or one.kind in arguments.kinds) and (not arguments.cases or one.name in arguments.cases)
    ]
    shutil.rmtree(arguments.out, ignore_errors=True)
    with ThreadPoolExecutor(WORKERS) as pool:
        outcomes = list(pool.map(lambda one: _run(one, arguments.out), chosen))
    counts = Counter[str](outcome.verdict for outcome in outcomes)
    messages = sorted({text for outcome in outcomes for text in outcome.messages})
    judged = json.loads(JUDGED.read_text(encoding="utf-8"))
    untrue = [text for text in messages if not judged.get(text)]
    (arguments.out / "messages.json").write_text(json.dumps(untrue, indent=1, ensure_ascii=False), encoding="utf-8")
    result: dict[str, Any] = {"inputs": len(chosen)} | {name: counts[name] for name in BAD} | {"untrue": len(untrue)}
    result["false_alarms"] = false_alarms(arguments.out / "real")
    print("RESULT", json.dumps(result))
    sys.exit(any(result[name] for name in (*BAD, "untrue")) or bool(result["false_alarms"]))


def every_case() -> Iterator[Case]:
    """All cases; their names are unique."""
    for name in plugins.names(cases.__name__):
        yield from plugins.module(cases.__name__, name).cases()


def _run(case: Case, out: Path) -> Outcome:
    folder = out / case.name
    folder.mkdir(parents=True)
    outcome = run(case, folder)
    shutil.rmtree(folder)
    if outcome.verdict != "right" or outcome.why:
        print(f"{outcome.verdict:14} {case.name}: {outcome.why}", flush=True)
    return outcome
