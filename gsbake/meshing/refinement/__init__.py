"""Moving the vertices of a mesh to agree with silhouettes, photos and rendered normals."""
