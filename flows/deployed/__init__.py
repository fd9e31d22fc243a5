"""Flows of Prefect over the same recipes: the only files that import it."""
