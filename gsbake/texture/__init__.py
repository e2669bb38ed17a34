"""UV atlas and baked textures."""
