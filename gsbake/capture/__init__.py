"""Capture: photos, masks, camera poses, structure from motion."""
