"""Sample records as nodes publish them."""

from __future__ import annotations

from typing import Any

from scan2sim.services.monitoring.record import Record

IDENTITY = "0123456789abcdef"


def record(name: str, time: float, **changed: Any) -> Record:
    """A record with a period of one second; its id depends on the second. `changed`: fields of `Record`."""
    fields: dict[str, Any] = {
        "id": f"{name}-{IDENTITY}:{int(time)}", "time": time, "period": 1.0, "node_name": name,
        "node_namespace": "/", "node_id": f"{name}-{IDENTITY}", "bandwidth": 3000.0, "messages": 3, "size": 1000.0,
        "out_bandwidth": 1000.0, "out_messages": 1, "out_size": 1000.0, "in_bandwidth": 2000.0, "in_messages": 2,
        "in_size": 1000.0, "latency": 2_000_000, "latency_p95": 3_000_000, "lost": 0, "publishers": 1, "subscribers": 1,
        "topics": ["/chatter"], "flows": [], "hostname": "edge", "local_ip": "10.0.0.1", "local_ips": ["10.0.0.1"],
        "endpoints": [], "cpu_times": {}, "cpu_percent": 12.0, "virtual_memory": {}, "disk_usage": [],
    }  # fmt: skip
    return Record(**fields | changed)


def body(name: str, time: float, **changed: Any) -> bytes:
    """A serialized record, as read from Kafka."""
    return record(name, time, **changed).json_line().encode()
