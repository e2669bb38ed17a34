"""Build engine: stages, cache keys, artifacts, leases and manifests. It contains nothing specific to 3D."""
