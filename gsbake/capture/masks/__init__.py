"""Masks of the object: which belongs to which photo, and completing them."""
