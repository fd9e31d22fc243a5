"""`python -m bench.teleop`."""

from bench.teleop.run import main

main()
