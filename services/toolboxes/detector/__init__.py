"""The project's own networks for toolboxes: what they are, how they are trained and exported."""
