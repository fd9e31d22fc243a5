"""Reports and web pages of tiles and surveys, quality findings, and the viewer of worlds."""
