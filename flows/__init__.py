"""Pipelines of steps, their execution, reports, and the `scan2sim` command."""
