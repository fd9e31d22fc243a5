"""`python -m bench.maps`."""

from bench.maps.run import main

main()
