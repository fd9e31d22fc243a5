"""Monitoring and event bus: topic statistics, alarms, autoscaling (docs/monitoring.md; D3.2, chapter 3)."""
