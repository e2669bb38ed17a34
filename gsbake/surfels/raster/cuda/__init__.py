"""The rasteriser on an NVIDIA GPU: torch projects, sorts and deals to tiles, Triton blends (docs/concepts/surfels.md)."""
