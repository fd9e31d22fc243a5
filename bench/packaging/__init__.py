"""Size of an installation."""
