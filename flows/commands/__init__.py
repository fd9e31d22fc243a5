"""Subcommands of `scan2sim`, one module each; none imports Prefect."""
