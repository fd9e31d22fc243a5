"""`python -m bench.recordings`."""

from bench.recordings.run import main

main()
