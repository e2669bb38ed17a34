"""2D Gaussian surfels with a discretized SDF, and their training."""
