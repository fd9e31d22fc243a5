"""`python -m bench.tile`."""

from bench.tile.run import main

main()
