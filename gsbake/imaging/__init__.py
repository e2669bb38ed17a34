"""Images as arrays: sRGB conversion, file formats, sampling, distance transform, similarity metrics."""
