"""Structure from motion with COLMAP, in a process of its own."""
