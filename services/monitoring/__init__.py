"""The smart event bus: every stream watched, alarms raised, workers asked for (docs/event-bus.md; D3.2, chapter 3)."""
