"""`python -m bench.gate`."""

from bench.gate.run import main

main()
