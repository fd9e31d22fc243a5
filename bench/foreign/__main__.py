"""`python -m bench.foreign`."""

from bench.foreign.run import main

if __name__ == "__main__":
    main()
