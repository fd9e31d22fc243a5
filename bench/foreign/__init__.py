"""Inputs as other programs write them; see `bench.foreign.run`."""
