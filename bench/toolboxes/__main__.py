"""`python -m bench.toolboxes`."""

from bench.toolboxes.run import main

main()
