"""Adding and removing surfels."""
