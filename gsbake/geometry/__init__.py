"""Cameras, meshes, point clouds, rays and tangent frames: what every step stands on."""
