"""Where records go: Kafka, files, Prometheus, an archive in Parquet.

Begin with `sinks`.
"""
