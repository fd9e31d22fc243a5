"""Instrumented nodes: statistics of their topics, measured and published as records.

Begin with `monitor`; `topic_monitor` observes topics from outside; `monitoring.record` defines the records.
"""
