"""Teleoperation: remote driving of a vehicle over several network links at once (D3.2, 4.3; docs/teleoperation.md)."""
