"""Execution of task graphs: planning, caching, processes and workers, memory budget, progress."""
