"""Metric scale: how many metres a unit of the photos' world is."""
