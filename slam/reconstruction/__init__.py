"""Structure from motion of unposed photos by COLMAP, and its registration to a point cloud."""
