"""Video to trajectory."""
