"""Images as arrays: colour curves, reading and writing, sampling, distances, similarity figures."""
