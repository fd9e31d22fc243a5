"""The project's own detection network: architecture, training, evaluation and export."""
