"""Built-in synthetic capture: analytic scene, reference renderer, ground truth."""
