"""Event queues and the node whose worker processes handle them.

Begin with `queue`; `local_workers` starts the processes.
"""
