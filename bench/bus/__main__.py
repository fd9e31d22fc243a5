"""`python -m bench.bus`."""

from bench.bus.run import main

main()
