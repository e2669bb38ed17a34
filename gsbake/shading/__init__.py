"""Light and reflection: the environment map, its prefiltered tables, the GGX BRDF and split-sum shading."""
