"""Limits the threads of libraries in the processes of steps; imported by their server before the libraries."""

from scan2sim.pipeline.core.cores import limit_threads

limit_threads()
