"""Sinks of records: Kafka, log files, Prometheus, and an archive in Parquet.

Begin with `sinks`.
"""
