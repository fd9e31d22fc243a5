"""`python -m bench.texture`."""

from bench.texture.run import main

main()
