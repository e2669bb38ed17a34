"""Test objects with known materials: procedural models, and captures of them rendered with Cycles."""
