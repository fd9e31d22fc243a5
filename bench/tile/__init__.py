"""The reconstruction compared with a straightforward chain of libraries: `python -m bench.tile`."""
