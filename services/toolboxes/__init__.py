"""ML toolboxes: inference on images with JSON results, independent of the model (D3.2, chapters 2 and 5)."""
