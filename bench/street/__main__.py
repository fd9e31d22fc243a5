"""`python -m bench.street`."""

from bench.street.run import main

main()
