"""Structure from motion with COLMAP, in a separate process."""
