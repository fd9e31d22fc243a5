"""Backdrop: the sky, and what is too far or too high for the scan, as surfaces textured from the photos.

`photos` prepares each photo, `plane_sweep` estimates the depth of what has no surface, `layers` fuses the depth maps
into one mesh, `layer_texture` makes its texture, `dome` collects the sky. Cameras show it; it has no collision shapes,
and lidars must not see it.
"""
