"""`python -m bench.slam`."""

from bench.slam.run import main

main()
