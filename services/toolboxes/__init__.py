"""ML toolboxes: images in, JSON results out, whatever the model behind (D3.2, chapters 2 and 5)."""
