"""Photos to classes per pixel to classes per point."""
