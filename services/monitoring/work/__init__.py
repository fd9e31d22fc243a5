"""Queues of events and the nodes that have workers process them.

Begin with `queue`.
"""
