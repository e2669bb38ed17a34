"""Targets: the asset for the places where it is used, at their budgets, with levels of detail; the film, USD, OBJ and splat files."""
