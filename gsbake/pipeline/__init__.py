"""The engine: stages, keys, cache, leases, manifests. It knows nothing of 3D."""
