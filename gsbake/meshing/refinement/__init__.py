"""Mesh refinement against silhouettes, photos and rendered normals."""
