"""A synthetic street with its ground truth: generator, and one small committed tile."""
