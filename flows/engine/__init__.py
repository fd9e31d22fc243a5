"""Runs graphs of steps: what of them would run, and why; in processes, on workers, within memory."""
