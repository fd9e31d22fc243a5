"""Example nodes for trying out the event bus: talker, dataset talker, listener and worker (D3.2, section 3.1)."""
