"""`python -m tests.fuzz [--cases N] [--first N] [KIND ...]`: outcomes of reading damaged files, counted per kind."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.fuzz.harness import Child, fuzz
from tests.fuzz.kinds import KINDS


def main() -> None:
    """Print a summary line per kind, the failures and the total counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("kinds", nargs="*", default=list(KINDS))
    arguments = parser.parse_args()
    child, codes, failures, slowest, largest = Child(), Counter[str](), list[str](), 0.0, 0.0
    for kind in arguments.kinds:
        with TemporaryDirectory() as folder:
            seeds = range(arguments.first, arguments.first + arguments.cases)
            tally = fuzz(kind, seeds, Path(folder) / "x", child)
        summary = ", ".join(f"{code}: {n}" for code, n in sorted(tally.codes.items(), key=str))
        print(f"{kind:24s} {summary}; {tally.seconds:.1f} s of processor time, {tally.mb:.0f} MB at most", flush=True)
        for failure in tally.failures:
            print("  " + failure.replace("\n", "\n    "), flush=True)
        codes.update({str(code): n for code, n in tally.codes.items()})
        failures += tally.failures
        slowest, largest = max(slowest, tally.seconds), max(largest, tally.mb)
    child.close()
    body = {
        "cases": sum(codes.values()), "codes": dict(codes), "failures": len(failures),
        "slowest_s": round(slowest, 1), "largest_mb": round(largest),
    }  # fmt: skip
    print(f"RESULT {json.dumps(body)}")


if __name__ == "__main__":
    main()
