"""From surfels to a mesh."""
