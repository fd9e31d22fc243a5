"""Quality of service of the event bus: events published over an emulated network (D3.2, table 3)."""
