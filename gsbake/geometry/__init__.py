"""Cameras, meshes, point clouds, ray casting and tangent frames."""
