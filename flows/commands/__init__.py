"""The `scan2sim` command, a file a command; without Prefect."""
