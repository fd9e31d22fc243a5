"""Acceptance gate: exported worlds are run in the programs that use them: `python -m bench.gate`."""
