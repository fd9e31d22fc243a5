"""The gate: exported worlds run through the programs that use them: `python -m bench.gate`."""
