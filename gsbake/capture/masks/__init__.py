"""Masks of the object: matching to photos, completion."""
