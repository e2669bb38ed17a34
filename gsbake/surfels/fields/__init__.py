"""Signed distance fields that surfels are trained with: one interface, one module per representation, a registry."""
