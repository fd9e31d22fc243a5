"""Quality of service: links as they are in the field, made on one machine (docs/event-bus.md)."""
