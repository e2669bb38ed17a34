"""Image-based lighting: environment map, prefiltering, GGX BRDF and split-sum shading."""
