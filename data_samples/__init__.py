"""The synthetic street: generator and one small committed tile."""
