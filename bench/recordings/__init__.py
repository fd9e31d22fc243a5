"""Benchmark of recordings: what importers make of them. Each part is a module with `measure(out) -> dict`."""
