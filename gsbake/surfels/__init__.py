"""2D Gaussian surfels with a discretized signed distance field."""
