"""Current traffic of each topic, summed over the latest records of the nodes that are alive."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from scan2sim.pipeline.core.errors import printable
from scan2sim.services.monitoring.record import Record, TopicFlow

MAX_TOPICS = 1000
"""Topics that are returned; the busiest ones."""
MAX_NAME_CHARS = 256


def topics(records: Iterable[Record]) -> list[dict[str, Any]]:
    """Statistics of the topics in nodes' latest records.

    Returns:
        JSON-serializable, by name: `topic`, `type`; `publishers` and `subscribers`, numbers of nodes that report it;
        `published` and `received`, messages per second; `bandwidth`, bytes per second that publishers send (without an
        instrumented publisher: that arrive); `latency` in seconds and `lost` messages per second of all subscribers;
        `size`, mean bytes. Null where unknown.
    """
    flows: dict[str, list[tuple[float, TopicFlow]]] = {}
    for record in records:
        for flow in record.flows:
            flows.setdefault(flow.topic, []).append((record.period, flow))
    busiest = sorted(flows, key=lambda name: -sum(flow.bandwidth for _, flow in flows[name]))[:MAX_TOPICS]
    return [_topic(name, flows[name]) for name in sorted(busiest)]


def _topic(name: str, flows: list[tuple[float, TopicFlow]]) -> dict[str, Any]:
    outgoing = [(period, flow) for period, flow in flows if flow.direction == "outgoing"]
    incoming = [(period, flow) for period, flow in flows if flow.direction == "incoming"]
    sent = outgoing or incoming
    messages = sum(flow.messages for _, flow in sent)
    timed = [flow for _, flow in incoming if flow.latency is not None and flow.messages]
    heard = sum(flow.messages for flow in timed)
    delay = sum((flow.latency or 0) * flow.messages for flow in timed)
    lost = [flow.lost / period for period, flow in incoming if flow.lost is not None]
    return {
        "topic": printable(name)[:MAX_NAME_CHARS],
        "type": printable(flows[0][1].type)[:MAX_NAME_CHARS],
        "publishers": len(outgoing),
        "subscribers": len(incoming),
        "published": _rate(outgoing),
        "received": _rate(incoming),
        "bandwidth": round(sum(flow.bandwidth for _, flow in sent), 1),
        "latency": round(delay / heard / 1e9, 6) if heard else None,
        "lost": round(sum(lost), 3) if lost else None,
        "size": round(sum(flow.size * flow.messages for _, flow in sent) / messages, 1) if messages else None,
    }


def _rate(flows: list[tuple[float, TopicFlow]]) -> float | None:
    """Messages per second; None without any flow."""
    return round(sum(flow.messages / period for period, flow in flows), 3) if flows else None
