"""Environment light and split-sum shading."""
