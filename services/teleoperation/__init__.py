"""Teleoperation: a vehicle driven from afar, by several links at once (D3.2, section 4.3; docs/teleoperation.md)."""
