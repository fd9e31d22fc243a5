"""ML toolboxes: images in, results out, whatever the model behind."""
