"""The rasteriser on an NVIDIA GPU: torch projects, sorts and deals to tiles, Triton blends (docs/cuda.md)."""
