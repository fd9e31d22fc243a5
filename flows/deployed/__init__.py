"""Prefect flows that run the same pipelines; the only modules that import Prefect."""
